"""Stage III: from the full-clip model to a four-step, block-causal simulator.

Three steps, each from the checkpoint before it: causal teacher forcing, four-step trajectory regression, and
distribution matching on the student's own rollouts.
"""
