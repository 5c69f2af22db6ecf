"""Who may ask, and for what: keys, their scopes, and the gate that every request goes through."""
