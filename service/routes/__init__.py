"""Routes: parse the request, call the library or the store, shape the reply."""
