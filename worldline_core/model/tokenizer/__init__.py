"""Video tokenizers: RGB in [-1, 1] to normalised latents and back, causal in time.

Axis legend: b batch, c channel, t frame, h w pixels; ``_l`` marks the latent grid.
"""
