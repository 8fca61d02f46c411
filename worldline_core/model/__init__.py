"""The world model: towers, action branch, view slots, block-causal attention, tokenizers, checkpoints.

Axis legend: b batch, v view, c latent channel, t latent frame, h w latent grid, n tokens, d model width.
"""
