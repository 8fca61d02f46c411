"""Action maps to token residuals (method.md section 2)."""

from __future__ import annotations

from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from worldline_core.errors import DataError


class ActionEncoder(nn.Module):
    """``Conv3D(9 -> 9, 1 x 3 x 3)`` added to its input, 2 x 2 patches, and a zero-initialised linear layer.

    Because the last layer starts at zero, a model that gains this branch computes what it computed before.
    """

    def __init__(self, channels: int, patch_size: int, hidden_size: int) -> None:
        super().__init__()
        self.channels = channels
        self.patch_size = patch_size
        self.conv = nn.Conv3d(channels, channels, kernel_size=(1, 3, 3), padding=(0, 1, 1))
        self.proj = nn.Linear(channels * patch_size**2, hidden_size)
        self.reset_output()

    def reset_output(self) -> None:
        """Set the last layer to zero."""
        nn.init.zeros_(self.proj.weight)
        nn.init.zeros_(self.proj.bias)

    def forward(self, maps: Float[Tensor, "b v c t h w"]) -> Float[Tensor, "b n d"]:
        """Residuals for the video tokens, in order ``(t v h w)``.

        Raises:
            DataError: the maps have another number of channels.
        """
        if maps.ndim != 6 or maps.shape[2] != self.channels:
            raise DataError(
                "Action maps have the wrong shape", expected=f"(b, v, {self.channels}, t, h, w)", got=tuple(maps.shape)
            )
        flat = rearrange(maps, "b v c t h w -> (b v) c t h w")
        flat = flat + self.conv(flat)
        patches = rearrange(
            flat,
            "(b v) c t (h p) (w q) -> b (t v h w) (p q c)",
            v=maps.shape[1],
            p=self.patch_size,
            q=self.patch_size,
        )
        return self.proj(patches)
