"""Robot segmenters: learned (embedded default), classical by colour, and SAM 3. All follow one protocol."""
