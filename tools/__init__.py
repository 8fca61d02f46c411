"""Tools for maintainers and tests: damaged recordings, labelled clips, importers of descriptions."""
