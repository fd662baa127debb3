"""Touching regions that are one surface: agglomeration on the graph of neighbours, cheapest description first.

Slow noise and bent calibration break one face into several, and planes that grow first leave a narrow cylinder as
facets. Two regions that meet without a step are joined when one surface describes both more cheaply than two do
(Schwarz's criterion over independent patches of noise), or when they meet without a crease either: then what parts them
is the error of the sensor, whatever the models say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.range import bend, fit
from perception.range.borders import Border, borders_of, step_and_turn
from perception.range.finish import FREE, SLOW_NOISE_AREA_PX, Samples, thinned
from perception.range.noise import NoiseModel
from perception.range.surfaces import PLANE, QUADRIC

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

PART_SAMPLES = 80
LEAST_BORDER_PX = 6
STEP_SIGMAS = 3.0
SHARPEST_TURN_RAD = 1.2  # between facets of one narrow cylinder; an edge of a box turns by 1.57
SMOOTH_TURN_RAD = 0.05
SMOOTH_SIGMAS = 3.0
SMOOTH_SHARE = 0.8  # of both parts within `SMOOTH_LIMIT` of the joint surface, when no crease parts them
SMOOTH_LIMIT = 5.0
LEAST_SHARE = 0.85
LEAST_GAIN = 1e-3
SCRAP_SHARE = 0.1  # of the larger part
PLAIN_MEAN_SQUARE = 1.6
MOST_NOISE = 2.5  # times the model's variance, that two parts may show and still be joined on its strength


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """A region while it is being joined: its surface, samples and their normals, and how well it is described.

    `patches` counts independent values of the noise; `mean_square` is what the surface leaves over, in squared sigmas;
    `tilt_sigma_rad` how far noise may turn it.
    """

    kind: int
    parameters: Array
    samples: Samples
    normals: Array
    pixels: int
    patches: float
    mean_square: float
    tilt_sigma_rad: float

    @property
    def price(self) -> float:
        """What Schwarz's criterion asks for the parameters: p ln n."""
        return bend.schwarz_price(self.kind, self.patches)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Merger:
    """One joint description of a pair; `gain` > 0 says how much cheaper it is than two."""

    pair: tuple[int, int]
    kind: int
    parameters: Array
    gain: float


class Agglomeration:
    """The graph of regions; joins the pair with the largest gain until none gains."""

    def __init__(
        self,
        kinds: list[int],
        parameters: list[Array],
        samples: list[Samples],
        *,
        borders: dict[tuple[int, int], Border],
        noise: NoiseModel,
        perspective: bool,
    ) -> None:
        self.noise = noise
        self.law = noise.packed()
        self.perspective = perspective
        self.parts: dict[int, Part] = {}
        for k, region in enumerate(samples, 1):
            if region.x.size:
                self.parts[k] = self._part(kinds[k - 1], parameters[k - 1], region)
        self.borders = dict(borders)
        self.owner = {k: k for k in range(1, len(kinds) + 1)}

    def run(self) -> None:
        """Join pairs, the most gainful first."""
        open_pairs = {pair: self._judged(pair) for pair in self.borders}
        while True:
            best = max((m for m in open_pairs.values() if m is not None), key=lambda m: (m.gain, m.pair), default=None)
            if best is None:
                return
            kept, lost = self._join(best)
            for pair in [p for p in open_pairs if kept in p or lost in p]:
                del open_pairs[pair]
            for pair in [p for p in self.borders if kept in p]:
                open_pairs[pair] = self._judged(pair)

    def _part(self, kind: int, th: Array, samples: Samples) -> Part:
        few = thinned(samples, PART_SAMPLES)
        patches = self._patches(samples.x.size, few)
        kind, th = bend.simplest(kind, th, few, self.perspective, patches=patches)
        normals = bend.surface_normals(kind, th, few, self.perspective)
        mean2, _ = self._explained(kind, th, few)
        return Part(
            kind=kind,
            parameters=th,
            samples=few,
            normals=normals,
            pixels=samples.x.size,
            patches=patches,
            mean_square=mean2,
            tilt_sigma_rad=self._tilt_sigma(few, patches),
        )

    def _patches(self, pixels: int, samples: Samples) -> float:
        slow = self.noise.slow_share(float(np.median(samples.z)))
        return max(pixels / (1.0 + slow * (SLOW_NOISE_AREA_PX - 1.0)), 1.0)

    def _tilt_sigma(self, samples: Samples, patches: float) -> float:
        """Standard deviation of the slope of a plane through `patches` noisy values: sigma / (spread sqrt(patches))."""
        z = samples.z if self.perspective else np.ones_like(samples.z)
        across = np.stack([samples.x * z, samples.y * z])
        least = float(np.linalg.eigvalsh(np.cov(across))[0]) if samples.x.size > 2 else 0.0
        return float(np.median(samples.sigma) / np.sqrt(max(least, 1e-12) * patches))

    def _explained(self, kind: int, th: Array, samples: Samples) -> tuple[float, float]:
        """Mean of squared residuals, each at most the trim's square, and the share of samples within the trim."""
        e = bend.residuals_of(kind, th, samples, self.perspective)
        limit = fit.TRIM_SIGMAS
        return float(np.mean(np.minimum(e * e, limit * limit))), float(np.mean(e < limit))

    def _judged(self, pair: tuple[int, int]) -> Merger | None:
        """The joint description of a pair if it gains, else None."""
        a, b = (self.parts.get(k) for k in pair)
        border = self.borders[pair]
        if a is None or b is None or border.length_px < LEAST_BORDER_PX:
            return None
        step, turn = step_and_turn(
            a.kind, a.parameters, b.kind, b.parameters, border.x, border.y, self.law, self.perspective
        )
        if step > STEP_SIGMAS * np.sqrt(_noise_here(a, b)) or turn > SHARPEST_TURN_RAD:
            return self._scrap(pair, a, b)
        tolerated = max(SMOOTH_TURN_RAD, SMOOTH_SIGMAS * float(np.hypot(a.tilt_sigma_rad, b.tilt_sigma_rad)))
        joint = self._jointly(pair, a, b, is_smooth=turn < min(tolerated, 0.5 * SHARPEST_TURN_RAD))
        return joint if joint is not None else self._scrap(pair, a, b)

    def _scrap(self, pair: tuple[int, int], a: Part, b: Part) -> Merger | None:
        big, small = (a, b) if a.pixels >= b.pixels else (b, a)
        if small.pixels > SCRAP_SHARE * big.pixels:
            return None
        surface = (big.kind, big.parameters)
        own = (small.kind, small.parameters)
        gain = bend.scrap_gain(surface, own, small.samples, small.pixels, self.noise, self.perspective)
        return Merger(pair=pair, kind=big.kind, parameters=big.parameters, gain=gain) if gain > 0.0 else None

    def _jointly(self, pair: tuple[int, int], a: Part, b: Part, *, is_smooth: bool) -> Merger | None:
        noise = _noise_here(a, b)
        best: Merger | None = None
        for kind, th in self._joint_fits(a, b):
            apart, together = a.price + b.price, bend.schwarz_price(kind, a.patches + b.patches)
            fits, near = True, is_smooth
            for p in (a, b):
                mean2, share = self._explained(kind, th, p.samples)
                fits = fits and mean2 <= noise * _mean_square_limit(p.patches) and share >= LEAST_SHARE
                e = bend.residuals_of(kind, th, p.samples, self.perspective)
                near = near and bool(np.mean(e < SMOOTH_LIMIT) > SMOOTH_SHARE)
                apart += p.mean_square * p.patches / noise
                together += mean2 * p.patches / noise
            gain = max(apart - together, LEAST_GAIN if near else 0.0)
            if (fits or near) and gain > (0.0 if best is None else best.gain):
                best = Merger(pair=pair, kind=kind, parameters=th, gain=gain)
        return best

    def _joint_fits(self, a: Part, b: Part) -> list[tuple[int, Array]]:
        both = _together(a.samples, b.samples)
        x, y, z = both.x, both.y, both.z
        points = bend.points_of(both, self.perspective)
        normals = np.concatenate([a.normals, b.normals])
        kinds = np.ones(5, np.bool_)
        kinds[QUADRIC] = QUADRIC in (a.kind, b.kind)
        correlated = max(x.size / (a.patches + b.patches), 1.0)
        ths, _, kept, score = fit.fit_kinds(
            points, points, normals, x, y, z, both.sigma, self.perspective, kinds, correlated
        )
        out = [(int(k), ths[k]) for k in range(5) if np.isfinite(score[k]) and kept[k] > 0.5]
        if PLANE == a.kind == b.kind and not np.isfinite(score[PLANE]):
            th, _, _, _, _ = fit.fit_robust(PLANE, a.parameters, x, y, z, both.sigma, self.perspective, FREE, 3)
            out.append((PLANE, th))
        return out

    def _join(self, merger: Merger) -> tuple[int, int]:
        """Replace the two parts by one; returns the label kept and the label lost."""
        a, b = merger.pair
        kept, lost = (a, b) if self.parts[a].pixels >= self.parts[b].pixels else (b, a)
        p, q = self.parts[kept], self.parts.pop(lost)
        samples, normals = _drawn(p, q)
        pixels, patches = p.pixels + q.pixels, p.patches + q.patches
        mean2, _ = self._explained(merger.kind, merger.parameters, samples)
        self.parts[kept] = Part(
            kind=merger.kind,
            parameters=merger.parameters,
            samples=samples,
            normals=normals,
            pixels=pixels,
            patches=patches,
            mean_square=mean2,
            tilt_sigma_rad=self._tilt_sigma(samples, patches),
        )
        for label, owner in self.owner.items():
            if owner == lost:
                self.owner[label] = kept
        self._rewire(kept, lost)
        return kept, lost

    def _rewire(self, kept: int, lost: int) -> None:
        for pair in [p for p in self.borders if lost in p]:
            border = self.borders.pop(pair)
            other = pair[0] if pair[1] == lost else pair[1]
            if other == kept:
                continue
            new = (min(kept, other), max(kept, other))
            self.borders[new] = self.borders[new].with_more(border) if new in self.borders else border


def merge_touching(
    labels: Ints,
    packed: Array,
    kinds: list[int],
    parameters: list[Array],
    samples: list[Samples],
    noise: NoiseModel,
) -> list[int]:
    """For each label (k at k - 1) the label it belongs to afterwards; updates kinds and parameters of the survivors."""
    graph = Agglomeration(
        kinds,
        parameters,
        samples,
        borders=borders_of(labels, packed),
        noise=noise,
        perspective=bool(packed[0] > 0),
    )
    graph.run()
    for label, part in graph.parts.items():
        kinds[label - 1], parameters[label - 1] = part.kind, part.parameters
    return [graph.owner[k] for k in range(1, len(kinds) + 1)]


def _noise_here(a: Part, b: Part) -> float:
    """How many times the noise model's variance the two parts show by themselves; slanted faces scatter more."""
    shown = (a.mean_square * a.patches + b.mean_square * b.patches) / (a.patches + b.patches)
    return min(max(1.0, shown), MOST_NOISE)


def _mean_square_limit(patches: float) -> float:
    """What a right surface stays below in 97 of 100 cases: 1 + 2 sqrt(2 / n) of a mean of n squares, and a floor."""
    return max(PLAIN_MEAN_SQUARE, 1.0 + 2.0 * float(np.sqrt(2.0 / patches)))


def _together(a: Samples, b: Samples) -> Samples:
    return Samples(
        x=np.concatenate([a.x, b.x]),
        y=np.concatenate([a.y, b.y]),
        z=np.concatenate([a.z, b.z]),
        sigma=np.concatenate([a.sigma, b.sigma]),
    )


def _drawn(p: Part, q: Part) -> tuple[Samples, Array]:
    """Samples and normals of both parts, each by its share of the pixels, at most `PART_SAMPLES` and at least a fifth."""
    share = min(max(q.pixels / (p.pixels + q.pixels), 0.2), 0.8)
    picks = []
    for part, wanted in ((p, 1.0 - share), (q, share)):
        n = part.samples.x.size
        count = min(n, max(1, round(wanted * PART_SAMPLES)))
        picks.append(np.linspace(0, n - 1, count).astype(np.int64))
    parts = [
        Samples(x=s.x[i], y=s.y[i], z=s.z[i], sigma=s.sigma[i])
        for s, i in zip((p.samples, q.samples), picks, strict=True)
    ]
    return _together(*parts), np.concatenate([p.normals[picks[0]], q.normals[picks[1]]])
