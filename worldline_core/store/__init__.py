"""The content-keyed artifact store."""
