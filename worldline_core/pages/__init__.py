"""Templates, tables, charts and styles of every page. Nothing is loaded from a network."""
