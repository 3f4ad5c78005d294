"""The results of an assessment: numbers of each technique on each object, as dataclasses, a table and JSON."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from full_geometry.scenes.scene_files import PATH_TRACED
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.provenance import without_nan

if TYPE_CHECKING:
    import pandas

NOISE = 0.01  # of the mean radiance, to which costs are told
UNNAMED = "object without an id (give its shape one in the scene)"
DOUBT = 1.0  # standard errors that count as error: biases spread over decades, and few lie where less is told


@dataclass(frozen=True)
class TechniqueTrade:
    """One way of rendering one object.

    Attributes:
        way: its name.
        bias2: squared relative error of radiance that no number of samples removes, noise taken out; it may come out
            below 0. Mean over visible exits and channels, over the square of the mean radiance.
        bias2_error: its standard error.
        ratio, ratio_error: mean radiance over that of walks, for each channel, with standard errors.
        variance, variance_error: of one sample without fireflies (`statistics.FIREFLIES`), over the square of the mean
            radiance, with its standard error.
        power: a, where the noise² of n samples of a pixel is the variance over n^a; below 1 for denoised walks.
        seconds: of one sample of the object, compilation left out.
        samples: that were taken for this.
        of_image: seconds of each image beside its samples, which a denoiser takes.
        preparation, compilation: seconds, once for a scene; kernels that were compiled before are found again.
        training: seconds, once for an object; 0 for what needs none.
        memory: most bytes that Dr.Jit held in a launch.
        refusal: why it could not be assessed; all numbers are nan then.
    """

    way: str
    bias2: float = math.nan
    bias2_error: float = math.nan
    ratio: tuple[float, ...] = ()
    ratio_error: tuple[float, ...] = ()
    variance: float = math.nan
    variance_error: float = math.nan
    seconds: float = math.nan
    samples: int = 0
    preparation: float = 0.0
    compilation: float = 0.0
    training: float = 0.0
    memory: int = 0
    power: float = 1.0
    of_image: float = 0.0
    refusal: str = ""

    @property
    def off(self) -> NoiseFree:
        """The bias with all that is known of it."""
        return NoiseFree(self.bias2, self.bias2_error)

    @property
    def told_bias(self) -> str:
        """The bias in percent, with its standard error or as a bound."""
        return "exact" if self.is_exact else self.off.told()

    @property
    def is_exact(self) -> bool:
        """Whether it has no bias: walks with sampled light, denoised or not, where no delta light shines, see
        `sampling.sample_blur`."""
        return self.bias2 == self.bias2_error == 0

    @property
    def bias(self) -> float:
        """Relative error of radiance that no number of samples removes."""
        return self.off.value

    @property
    def bias_error(self) -> float:
        """Standard error of the bias; where that is lost in noise, of its bound."""
        return self.off.standard_error

    @property
    def bias_bound(self) -> float:
        """A bound that the bias is below in 95 % of cases; a square that came out below 0 counts as 0."""
        return self.off.bound

    @property
    def once(self) -> float:
        """Seconds before the first image."""
        return self.preparation + self.training

    def job_seconds(self, images: int, samples: float) -> float:
        """Seconds of so many images that take so many samples of the object each."""
        return self.once + images * (samples * self.seconds + self.of_image)

    def time_to(self, noise: float) -> float:
        """Seconds for each pixel of the object until its noise is so much of the mean radiance."""
        return (self.variance / noise**2) ** (1 / self.power) * self.seconds

    @property
    def cost(self) -> float:
        """Variance of a sample times its seconds; of denoised walks what plain ones as good at 1 % would have."""
        return self.time_to(NOISE) * NOISE**2

    def noise2(self, spp: float) -> float:
        """Squared relative noise of so many samples of a pixel."""
        return self.variance / spp**self.power


def samples_for(row: TechniqueTrade, tolerance: float) -> float:
    """Samples n of a pixel that bring bias² + noise² and what counts of their errors to tolerance²; inf for none.

    With a = tolerance² - bias² and x = n^power the smaller root of (a - V / x)² = s² + (v / x)².
    """
    a, s, v = tolerance**2 - max(row.bias2, 0.0), DOUBT * row.bias2_error, DOUBT * row.variance_error
    if not a > s:
        return math.inf
    V = row.variance
    x = (a * V + math.sqrt(max(a**2 * V**2 - (V**2 - v**2) * (a**2 - s**2), 0.0))) / (a**2 - s**2)
    return x ** (1 / row.power)


@dataclass(frozen=True)
class ObjectTrade:
    """One object of a scene.

    Attributes:
        object: its id.
        mfp: mean free paths across, smallest and largest of the channels.
        share: of the image that it fills; 0 if it is not seen, and nothing is known of it.
        pixels: of the film that it fills.
        radiance: its mean, for each channel.
        ways: what was found, path traced first.
        notes: what cannot be known, and warnings.
    """

    object: str
    mfp: tuple[float, float]
    share: float
    pixels: float
    radiance: tuple[float, ...]
    ways: tuple[TechniqueTrade, ...]
    notes: tuple[str, ...] = ()

    def way(self, name: str) -> TechniqueTrade:
        """The row of a way; ValueError if there is none."""
        for row in self.ways:
            if row.way == name:
                return row
        raise ValueError(f"way must be one of {', '.join(row.way for row in self.ways)}, got {name!r}")

    def job(self, row: TechniqueTrade, tolerance: float, images: int = 1) -> tuple[float, int]:
        """Seconds of a job by a way, and samples of a pixel; infinite and 0 if it may not keep the tolerance."""
        needed = samples_for(row, tolerance)
        if not needed < math.inf:
            return math.inf, 0
        spp = max(math.ceil(needed), 1)
        return row.job_seconds(images, self.pixels * spp), spp

    @property
    def traced(self) -> TechniqueTrade:
        return self.way(PATH_TRACED)

    @property
    def is_dark(self) -> bool:
        return not any(value > 0 for value in self.radiance)


@dataclass(frozen=True)
class Assessment:
    """All objects of a scene.

    Attributes:
        objects: in the order of the scene.
        seconds: spent, compilation left out; `compilation` was spent beside.
        seed: of the samples.
    """

    objects: tuple[ObjectTrade, ...]
    seconds: float
    compilation: float
    seed: int

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Assessment:
        objects = []
        for o in record["objects"]:
            rows = tuple(TechniqueTrade(**{key: _known(key, value) for key, value in w.items()}) for w in o["ways"])
            lists = {key: tuple(o[key]) for key in ("mfp", "radiance", "notes")}
            objects.append(ObjectTrade(**{**o, **lists, "ways": rows}))
        return cls(tuple(objects), record["seconds"], record["compilation"], record["seed"])

    def table(self) -> pandas.DataFrame:
        """One row for each object and way."""
        import pandas

        rows: list[dict[str, Any]] = []
        for each in self.objects:
            for w in each.ways:
                row: dict[str, Any] = {"object": each.object, "mfp_min": each.mfp[0], "mfp_max": each.mfp[1]}
                row |= {"way": w.way, "bias": w.bias, "bias_standard_error": w.bias_error, "bias_bound": w.bias_bound}
                row |= {"bias2": w.bias2, "bias2_standard_error": w.bias2_error}
                for k, (value, error) in enumerate(zip(w.ratio, w.ratio_error)):
                    row |= {f"ratio_{k}": value, f"ratio_{k}_standard_error": error}
                row |= {"variance": w.variance, "variance_standard_error": w.variance_error}
                row |= {"seconds_per_million": 1e6 * w.seconds, "samples": w.samples, "preparation_s": w.preparation}
                row |= {"compilation_s": w.compilation, "training_s": w.training, "memory_MB": w.memory / 1e6}
                row |= {"refusal": w.refusal}
                rows.append(row)
        return pandas.DataFrame(rows)

    def record(self) -> dict[str, Any]:
        """Ready for JSON; what is not known is None there."""
        return without_nan(asdict(self))


def _known(key: str, value: object) -> object:
    """A field of a `TechniqueTrade` from JSON."""
    if key in ("ratio", "ratio_error"):
        return tuple(math.nan if v is None else v for v in value)
    return math.nan if value is None else value
