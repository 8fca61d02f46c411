"""The simulator as a server (`worldline serve`), its Python client, and the page to drive it by hand (`worldline play`)."""
