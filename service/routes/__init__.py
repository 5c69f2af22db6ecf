"""The routes: parse, call, shape the reply."""
