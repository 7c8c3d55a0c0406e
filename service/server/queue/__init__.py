"""The job engine: few verbs, and DBOS behind them."""
