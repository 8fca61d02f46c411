"""Video and images: reading, copying, writing, resizing and the small grey pictures that filters look at."""
