"""How an interrupted run goes on: from the journal to a plan that a person confirms."""
