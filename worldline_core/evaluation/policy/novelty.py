"""How far the controls and the setup of a simulation are from everything that its model was trained on.

Both are compared with the training recordings. Controls are compared step by step: where the tools are from where they began, how fast they
move and how far the grippers are open, in windows of two latent frames, each with the same moment of every training recording
of as many arms. The setup is which body it is, and where its head camera stands and how wide it sees, compared with the
training recordings of the same body. The novelty is the distance to the nearest training recording, of the window that is
farthest, in units of the distance that a share ``1 - level`` of the training recordings stay within among themselves. So only a
share ``level`` of the training recordings would be above 1: nearest-neighbour novelty detection with the threshold of conformal
prediction (Laxhammar and Falkman 2010). First pictures themselves tell little here: scenes are varied so much that statistics of
their latents hardly tell an unseen body or camera from an unseen scene.

Axis legend: r recordings, w windows, f features, n frames, a arms.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import cdist

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import HEAD_VIEW, ActionTracks, EpisodeTracks
from worldline_core.data.episodes.episode import TRAINING_SPLITS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.evaluation_config import TrustConfig

PLACE_M, SPEED_M, OPENING = 0.1, 0.05, 0.5
"""Differences that count as much as each other: of place, of the way in a latent frame, of a gripper's opening (share)."""
LEAST_RECORDINGS = 5
"""Fewer training recordings say too little of how far they are from each other."""
MOST_RECORDINGS = 2000

Kind = Hashable
"""What can be compared: recordings of as many arms, or of the same body."""


class KnownRecordings:
    """Training recordings as vectors, and how far others are from them.

    Args:
        recordings: kind and vectors ``(w, f)`` of each; of more than 2,000 of one kind, 2,000 are drawn.
        what: what the recordings are, for the error message.
        level: share of the training recordings whose own novelty is above 1.

    Raises:
        DataError: no kind has five recordings.
    """

    def __init__(
        self,
        recordings: Iterable[tuple[Kind, Float[np.ndarray, "w f"]]],
        what: str = "training recordings",
        *,
        level: float = 0.05,
        seed: int = 0,
    ) -> None:
        found: dict[str, list[np.ndarray]] = defaultdict(list)
        for kind, vectors in recordings:
            found[str(kind)].append(vectors)
        counts = {kind: len(vectors) for kind, vectors in found.items()}
        random = np.random.default_rng(seed)
        self._known = {
            kind: _Neighbours.of([vectors[i] for i in random.permutation(len(vectors))[:MOST_RECORDINGS]], level)
            for kind, vectors in found.items()
            if len(vectors) >= LEAST_RECORDINGS
        }
        if not self._known:
            raise DataError(
                "Too few training recordings to tell what is new",
                expected=f"{LEAST_RECORDINGS} {what} of as many arms or of one body", got=counts or "none",
                next_step="add recordings of the training splits to the episodes (a source of curate), or leave "
                "evaluate_policy.trust out",
            )  # fmt: skip

    def novelty(self, kind: Kind, vectors: Float[np.ndarray, "w f"]) -> float:
        """Novelty of a recording; infinite where fewer than five training recordings are of its kind."""
        known = self._known.get(str(kind))
        return float("inf") if known is None else known.novelty(vectors)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays to save, by name, for :meth:`of_arrays`."""
        return {f"{kind}/{name}": array for kind, found in self._known.items() for name, array in found.arrays.items()}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray]) -> KnownRecordings:
        """From what :meth:`arrays` gave. Raises: KeyError where some are missing."""
        of_kind: dict[str, dict[str, np.ndarray]] = defaultdict(dict)
        for name, array in arrays.items():
            kind, _, part = name.rpartition("/")
            of_kind[kind][part] = array
        made = cls.__new__(cls)
        made._known = {kind: _Neighbours(found) for kind, found in of_kind.items()}
        return made


class _Neighbours:
    """Training recordings of one kind: ``window_0 (r, f)``, ..., ``scale (w)`` of their distances, and ``limit``."""

    def __init__(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.arrays = arrays
        self._scale, self._limit = arrays["scale"], float(arrays["limit"][0])
        self._windows = [arrays[f"window_{w}"] for w in range(len(self._scale))]

    @classmethod
    def of(cls, recordings: Sequence[np.ndarray], level: float) -> _Neighbours:
        lengths = np.array([len(vectors) for vectors in recordings])
        # Windows that hardly any training recording reaches are not compared.
        windows = int(np.sort(lengths)[-LEAST_RECORDINGS])
        known = [np.stack([r[w] for r in recordings if len(r) > w]) for w in range(windows)]
        own = np.zeros((windows, len(recordings)))
        for w, vectors in enumerate(known):
            apart = cdist(vectors, vectors)
            np.fill_diagonal(apart, np.inf)
            own[w, lengths > w] = apart.min(axis=1)
        # Some windows are harder to match than others: each is measured in units of its median distance.
        scale = np.array([max(float(np.median(own[w, lengths > w])), 1e-6) for w in range(windows)])
        limit = np.quantile((own / scale[:, None]).max(axis=0), 1.0 - level)
        return cls({f"window_{w}": vectors for w, vectors in enumerate(known)} | {"scale": scale, "limit": limit[None]})

    def novelty(self, vectors: np.ndarray) -> float:
        apart = [
            float(cdist(vector[None], known).min()) / scale
            for vector, known, scale in zip(vectors, self._windows, self._scale, strict=False)
        ]
        return max(apart, default=0.0) / max(self._limit, 1e-6)


def control_vectors(
    T_base_tool: Float[np.ndarray, "n a 4 4"], gripper: Float[np.ndarray, "n a"]
) -> tuple[int, Float[np.ndarray, "w f"]]:
    """(number of arms, vectors) of the controls of a recording, or of those of a simulation so far: tools, and openings.

    Raises: DataError for fewer frames than a window has.
    """
    place = np.asarray(T_base_tool, dtype=np.float64)[::TEMPORAL_FACTOR, :, :3, 3]
    opening = np.asarray(gripper, dtype=np.float64)[::TEMPORAL_FACTOR]
    if len(place) < 2:
        raise DataError(
            "Too few frames to compare their controls", expected=f"more than {TEMPORAL_FACTOR}", got=len(T_base_tool)
        )
    step = np.diff(place, axis=0, prepend=place[:1])
    away, way = (
        (values / unit).reshape(len(place), -1) for values, unit in ((place - place[:1], PLACE_M), (step, SPEED_M))
    )
    rows = np.concatenate([away, opening / OPENING, way], axis=1)
    return place.shape[1], np.concatenate([rows[:-1], rows[1:]], axis=1)


def _controls(tracks: EpisodeTracks) -> tuple[int, Float[np.ndarray, "w f"]]:
    return control_vectors(tracks.T_base_tool, tracks.gripper[:, 0])


def _has_head_camera(tracks: EpisodeTracks) -> bool:
    return tracks.camera_motion[tracks.views.index(HEAD_VIEW)] != "absent"


def setup_vectors(tracks: EpisodeTracks) -> tuple[str, Float[np.ndarray, "1 f"]]:
    """(embodiment, vector) of a recording: pose of its head camera at the start [m, columns of its rotation], and its K."""
    head = tracks.views.index(HEAD_VIEW)
    pose, K = tracks.T_base_camera[0, head].astype(np.float64), tracks.K[head].astype(np.float64)
    height, width = tracks.image_size
    lens = np.array([K[0, 0] / width, K[1, 1] / height, K[0, 2] / width, K[1, 2] / height])
    return tracks.embodiment, np.concatenate([pose[:3, 3] / PLACE_M, pose[:3, :3].ravel(), lens / PLACE_M])[None]


@dataclass(frozen=True)
class KnownSetting:
    """Controls and setups of the training recordings among the episodes; ``count`` of them have action tracks."""

    tracks: ActionTracks
    controls: KnownRecordings
    setups: KnownRecordings
    count: int

    @classmethod
    def of(
        cls,
        episodes: EpisodeSet,
        tracks: ActionTracks | None,
        config: TrustConfig,
        saved: tuple[KnownRecordings, KnownRecordings, int] | None = None,
    ) -> KnownSetting:
        """Reads the recordings of the training splits, or takes those that were ``saved``: controls, setups, count.

        Raises: ConfigError without action tracks; DataError where there are too few training recordings.
        """
        if tracks is None:
            raise ConfigError(
                "Trust in verdicts is judged from the controls", where="evaluate_policy.trust", expected="the input tracks",
                next_step="run render_actions and give its folder as --input tracks=FOLDER",
            )  # fmt: skip
        if saved is not None:
            return cls(tracks, *saved)
        names = [row.episode_id for row in episodes.rows if row.split in TRAINING_SPLITS and row.episode_id in tracks]
        known = [tracks.tracks(name) for name in names]
        level = config.novelty_level
        with_camera = [track for track in known if _has_head_camera(track)]
        return cls(
            tracks,
            KnownRecordings(map(_controls, known), "controls of training recordings", level=level),
            KnownRecordings(
                map(setup_vectors, with_camera), "training recordings with a known head camera", level=level
            ),
            len(known),
        )

    def novelties(self, episode_id: str) -> dict[str, float | None]:
        """``new_controls`` and ``new_setup`` of a prediction; None without its tracks, or without its head camera."""
        if episode_id not in self.tracks:
            return {"new_controls": None, "new_setup": None}
        track = self.tracks.tracks(episode_id)
        setup = self.setups.novelty(*setup_vectors(track)) if _has_head_camera(track) else None
        return {"new_controls": self.controls.novelty(*_controls(track)), "new_setup": setup}
