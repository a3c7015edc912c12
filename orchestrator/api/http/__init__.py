"""HTTP: the application, authentication, limits, connections."""
