"""Search over sequences of controls: best of N, CEM, iCEM and MPPI, each by scores of whole sequences alone.

A solver is a generator: it yields candidates ``(k, n, j)``, is sent their scores ``(k,)`` (higher is better), and ends when its
candidates are used up. :func:`search` scores them in batches, stops early where it may, and keeps the best-scored sequence of
all (or the first one, within a margin): with a model that gives equal controls equal videos, no average of sequences is worth more than one that was scored.

Axis legend: k candidates, n frames, j columns of the embodiment's state.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Float

from worldline_core.errors import DataError

Sequences = Float[np.ndarray, "k n j"]
Batches = Generator[Sequences, Float[np.ndarray, " k"], None]
Stopped = Literal["candidates", "time", "certain"]


@dataclass(frozen=True)
class Space:
    """What is searched.

    Attributes:
        propose: so many new sequences.
        limit: the nearest sequences that the robot can execute.
        kept: ``(m, n, j)``, m >= 0, what is left of an earlier search's sequences, best first.
    """

    propose: Callable[[int], Sequences]
    limit: Callable[[Sequences], Sequences]
    kept: Sequences
    random: np.random.Generator

    def first(self, count: int, kept: int = 1) -> Sequences:
        """The best ``kept`` of an earlier search, then new proposals; ``count`` in all."""
        known = self.kept[: min(kept, count)]
        fresh = [self.propose(count - len(known))] if count > len(known) else []
        return self.limit(np.concatenate([known, *fresh]))


Solver = Callable[[Space, int], Batches]
"""Batches of the solver, of at most so many candidates together; the very first is what is left of an earlier search, if anything is
(:meth:`Space.first` puts it there): a margin is in its favour."""


@dataclass(frozen=True)
class Found:
    """Result of a search: sequences ``(k, n, j)`` and their scores ``(k,)``, the chosen one first, then the better before the
    worse, and why it stopped."""

    sequences: Sequences
    scores: Float[np.ndarray, " k"]
    stopped: Stopped
    seconds: float


def best_of_n(space: Space, count: int) -> Batches:
    """Proposals alone."""
    yield space.first(count)


def cross_entropy(
    space: Space, count: int, *, colour: float, carried: float, decay: float, rounds: int = 3, elite_share: float = 0.3
) -> Batches:
    """CEM (Rubinstein 1999): each round is drawn from a normal distribution around the best ones of the round before.

    iCEM (Pinneri et al. 2020, section 3) adds noise that is correlated in time, elites carried from round to round and from one
    search to the next, rounds that shrink, and the mean as a candidate of the last round.

    Args:
        colour: exponent of the noise's spectrum over time, 0 white.
        carried: share of the elites that compete in the next round, and that an earlier search hands on.
        decay: each round has ``1 / decay`` times the candidates of the one before.
    """
    sizes = _sizes(count, rounds, decay)
    elites = max(2, round(elite_share * sizes[0]))
    batch = space.first(sizes[0], kept=max(1, round(carried * elites)))
    mean = deviation = np.zeros(batch.shape[1:])
    pool, values = batch[:0], np.empty(0)
    for number, size in enumerate(sizes):
        if number:
            batch = mean + deviation * coloured_noise(space.random, (size, *mean.shape), colour)
            if number == len(sizes) - 1:
                batch[0] = mean
            batch = space.limit(batch)
        scores = yield batch
        pool, values = np.concatenate((pool, batch)), np.concatenate((values, scores))
        best = np.argsort(-values, kind="stable")[:elites]
        smoothed = 0.9 if number else 1.0
        mean = smoothed * pool[best].mean(axis=0) + (1 - smoothed) * mean
        deviation = smoothed * pool[best].std(axis=0) + (1 - smoothed) * deviation
        best = best[: round(carried * elites)]
        pool, values = pool[best], values[best]


def mppi(
    space: Space, count: int, *, rounds: int = 3, temperature: float = 0.3, cooling: float = 0.6, colour: float = 2.0
) -> Batches:
    """MPPI (Williams et al. 2017, equations 27 to 34): a nominal sequence moves to the mean of what was drawn around it, weighted
    by ``exp(score / lambda)``.

    Args:
        temperature: lambda, in standard deviations of a round's scores.
        cooling: the noise of each round against that of the one before; the first round's is the spread of the proposals.
        colour: as of :func:`cross_entropy`.
    """
    sizes = _sizes(count, rounds, 1.0)
    batch = space.first(sizes[0])
    nominal, deviation = batch[0], batch.std(axis=0)
    for number, size in enumerate(sizes):
        if number:
            deviation = cooling * deviation
            noise = coloured_noise(space.random, (size, *deviation.shape), colour)
            noise[0] = 0.0
            batch = space.limit(nominal + deviation * noise)
        scores = yield batch
        weights = np.exp((scores - scores.max()) / max(temperature * float(scores.std()), 1e-12))
        nominal = np.tensordot(weights / weights.sum(), batch, axes=1)


SOLVERS: dict[str, Solver] = {
    "best_of_n": best_of_n,
    "cem": partial(cross_entropy, colour=0.0, carried=0.0, decay=1.0),
    "icem": partial(cross_entropy, colour=2.0, carried=0.5, decay=1.25),
    "mppi": mppi,
}


def search(
    batches: Batches,
    evaluate: Callable[[Sequences], Float[np.ndarray, " k"]],
    *,
    batch: int,
    seconds: float | None = None,
    certain: float | None = None,
    margin: float = 0.0,
    clock: Callable[[], float] = time.perf_counter,
) -> Found:
    """Score a solver's candidates, ``batch`` at a time, until they are used up or one of the limits is reached.

    Args:
        seconds: no batch is begun that would, lasting as long as the longest one so far, end later than this. The first is
            always scored: without it there is nothing to choose.
        certain: a score from which on nothing better is looked for.
        margin: the first candidate is chosen unless another scores better by more than this.

    Raises:
        DataError: a score is not finite.
    """
    began, longest = clock(), 0.0
    sequences: list[np.ndarray] = []
    scores: list[float] = []

    def found(stopped: Stopped) -> Found:
        batches.close()
        ranked = np.array(scores)
        if ranked.max() <= ranked[0] + margin:
            ranked[0] = np.inf
        order = np.argsort(-ranked, kind="stable")
        return Found(np.concatenate(sequences)[order], np.array(scores)[order], stopped, clock() - began)

    candidates = next(batches)
    while True:
        for start in range(0, len(candidates), batch):
            before = clock()
            if scores and seconds is not None and before - began + longest > seconds:
                return found("time")
            part = candidates[start : start + batch]
            values = np.asarray(evaluate(part), dtype=np.float64)
            if values.shape != (len(part),) or not np.isfinite(values).all():
                raise DataError(
                    "A score is not a finite number",
                    where=f"candidates {len(scores)} to {len(scores) + len(part) - 1} of the search",
                    expected=f"{len(part)} finite scores, higher is better",
                    got=values.tolist(),
                    next_step="let the score function give its lowest score to a video in which it sees nothing",
                )
            sequences.append(part)
            scores += values.tolist()
            longest = max(longest, clock() - before)
            if certain is not None and values.max() >= certain:
                return found("certain")
        try:
            candidates = batches.send(np.array(scores[-len(candidates) :]))
        except StopIteration:
            return found("candidates")


def coloured_noise(random: np.random.Generator, shape: tuple[int, ...], colour: float) -> Sequences:
    """Normal noise ``(k, n, j)`` of unit variance whose power over the frames falls with frequency to the power ``-colour``."""
    frames = shape[1]
    powers = [np.maximum(np.abs(f), 1 / frames) ** -colour for f in (np.fft.rfftfreq(frames), np.fft.fftfreq(frames))]
    spectrum = np.fft.rfft(random.standard_normal(shape), axis=1) * np.sqrt(powers[0])[:, None]
    return np.fft.irfft(spectrum, frames, axis=1) / np.sqrt(powers[1].mean())


def _sizes(count: int, rounds: int, decay: float) -> list[int]:
    """Candidates of each round; with few of them fewer rounds, so that each has some to compare."""
    shares = decay ** -np.arange(max(1, min(rounds, count // 3)), dtype=np.float64)
    edges = np.round(count * np.cumsum(shares) / shares.sum()).astype(int)
    return np.diff(edges, prepend=0).tolist()
