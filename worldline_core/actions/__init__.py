"""Action rendering: controls to tracks, tracks to nine-channel maps, robot masks, previews."""
