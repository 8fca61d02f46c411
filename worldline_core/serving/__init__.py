"""The simulator as a server (`worldline serve`), and its Python client."""
