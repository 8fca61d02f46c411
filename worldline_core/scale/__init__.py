"""Work on many episodes: cut into shards, done by any mapper, and every input accounted for."""
