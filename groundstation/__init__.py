"""The operator's side: read flights, compare them with models, diagnose, fit, train, deploy, look."""
