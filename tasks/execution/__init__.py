"""The machinery under the verbs: one object a verb, runs with and without Prefect, the command line."""
