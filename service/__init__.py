"""The HTTP service: thin routes over liftcore, a store and a job runner."""
