"""Work on many episodes: shards as data, the interface of what maps them, object stores, and what is retried."""
