"""Recovery of an interrupted run: from the journal to a plan that a person confirms."""
