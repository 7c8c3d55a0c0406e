"""Who may ask for what: host names, tokens, scopes, rates, stops."""
