"""Training of the world model: cached latents, clip sampling, flow matching, Stage I and Stage II.

Axes: b clip, v view, c channel, t latent frame, h/w latent rows/columns, d feature.
"""
