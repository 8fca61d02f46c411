"""What maintainers and tests use and no user runs: damaged recordings, labelled clips, importers of descriptions."""
