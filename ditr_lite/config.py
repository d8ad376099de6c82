"""Every size and constant of the system, in frozen dataclasses, and the three presets built from them.

``tiny`` runs in tests and live notebook cells, ``lite`` is what the shipped weights were trained with, ``paper`` is
what the paper states (Sec. IV and V-B) wherever it states something.
"""

from dataclasses import asdict, dataclass, field, fields, is_dataclass
from numbers import Real
from typing import Any, get_args, get_type_hints


def check_kernels(median: int, dilate: int, iterations: int) -> None:
    """Refuse what no mask can be refined with.

    Raises:
        ValueError: for an even kernel or a negative number.
    """
    for name, size in (("median", median), ("dilate", dilate)):
        if size < 0 or (size > 0 and size % 2 == 0):
            raise ValueError(f"expected an odd {name} kernel (or 0 for none), got {size}: an even one shifts the mask")
    if iterations < 0:
        raise ValueError(f"expected iterations >= 0, got {iterations}")


def _at_least(minimum: int, group: str, **values: int) -> None:
    if wrong := [f"{name} {value}" for name, value in values.items() if value < minimum]:
        raise ValueError(f"{group}: expected at least {minimum}, got {', '.join(wrong)}")


def _at_most(maximum: int, group: str, **values: int) -> None:
    if wrong := [f"{name} {value}" for name, value in values.items() if value > maximum]:
        raise ValueError(f"{group}: expected at most {maximum}, got {', '.join(wrong)}")


WIDEST = 512  # channels of a first level


COLOURS = ("pretrained", "scratch")  # encoders of the picture in stage one


@dataclass(frozen=True)
class RegionConfig:
    """Stage one: the RGB-D segmentation network (Paper: Sec. IV-B, "TROSNet")."""

    width: int = 16  # channels at stride 2; doubled at every further level down to stride 16
    levels: int = 4  # strides 2, 4, 8, 16, ...
    classes: int = 3  # background, transparent, reflective
    colour: str = "pretrained"  # encoder of the picture: "pretrained" (on ImageNet) or "scratch" (as for depth)
    attention: int = 0  # transformer blocks at each of the two coarsest levels
    blocks: int = 0  # residual blocks at each of the decoder's finer levels

    def __post_init__(self) -> None:
        _at_least(1, "region", width=self.width)
        _at_least(2, "region", levels=self.levels, classes=self.classes)
        _at_least(0, "region", attention=self.attention, blocks=self.blocks)
        if self.colour not in COLOURS:
            raise ValueError(f"unknown region.colour {self.colour!r}; choose one of {', '.join(COLOURS)}")
        _at_most(6, "region", levels=self.levels)  # at stride 64 a working picture is 3 x 4 pixels
        _at_most(WIDEST, "region", width=self.width)


@dataclass(frozen=True)
class RefineConfig:
    """From stage one's network to the region (Paper: Sec. IV-B): looks, probability, median filter, dilation.

    The paper looks once. Logits of several ``looks`` are averaged; kernels are in pixels of the mask they are given.
    """

    median: int = 7
    dilate: int = 5
    iterations: int = 3
    threshold: float = 0.5  # probability above which a pixel is claimed
    temperature: float = 1.0  # logits are divided by it, so that the probability means what it says
    looks: tuple[float, ...] = (1.0,)  # sizes, of the working size, at which a frame is seen; trained for the first

    def __post_init__(self) -> None:
        if not 0 < self.threshold < 1 or not self.temperature > 0:
            raise ValueError(
                f"refine: expected a threshold between 0 and 1 and a temperature above 0, "
                f"got {self.threshold} and {self.temperature}"
            )
        check_kernels(self.median, self.dilate, self.iterations)
        if not self.looks or min(self.looks) < 1:
            raise ValueError(f"refine.looks: expected at least one size and none below 1, got {self.looks}")


@dataclass(frozen=True)
class AutoencoderConfig:
    """VQ autoencoder (Paper: Sec. IV-C, "Latent Space"): two down- and two up-samplings, quantiser in the decoder."""

    latent_channels: int = 4
    codes: int = 2048
    width: int = 32
    multipliers: tuple[int, ...] = (1, 2)  # at strides 2 and 4; nothing wide runs at stride 1
    res_blocks: int = 1
    commitment: float = 0.25

    def __post_init__(self) -> None:
        _at_least(1, "autoencoder", latent_channels=self.latent_channels, codes=self.codes, width=self.width)
        _at_most(WIDEST, "autoencoder", latent_channels=self.latent_channels, width=self.width)
        _at_most(2**20, "autoencoder", codes=self.codes)
        _at_least(1, "autoencoder.multipliers", smallest=min(self.multipliers, default=1))


@dataclass(frozen=True)
class ScheduleConfig:
    """Noise schedule: 1,000 steps (Paper: Sec. V-B); ``name`` is one of ``schedule.SCHEDULES``."""

    name: str = "scaled_linear"
    timesteps: int = 1000
    beta_start: float = 0.0015
    beta_end: float = 0.0195


COLOUR_CHANNELS = (24, 40, 112)  # of the pretrained encoder's features at strides 4, 8 and 16


@dataclass(frozen=True)
class UNetConfig:
    """Denoising U-Net (Paper: Sec. IV-C, "Denoising Step"): four levels, channels double per level."""

    width: int = 32
    multipliers: tuple[int, ...] = (1, 2, 4, 8)
    attention_levels: tuple[int, ...] = (2, 3)  # levels with self- and cross-attention
    heads: int = 4
    query: str = "feature"  # cross-attention: "feature" (the paper's) or "latent" (latent diffusion's)
    block: str = "residual"  # "residual" (GroupNorm, SiLU) or "plain" (the paper's 3x3 conv + ReLU)
    cond_channels: int = 32  # channels of F(x) that are concatenated to L_t
    colour_channels: tuple[int, ...] = COLOUR_CHANNELS  # of the pretrained encoder's features; () takes none
    anchor: bool = True  # predict what to add to the encoded known depth; only with prediction "x0" (not in the paper)

    def __post_init__(self) -> None:
        _at_least(1, "unet", width=self.width, heads=self.heads, cond_channels=self.cond_channels)
        if self.width % 2:  # half sines, half cosines of the step
            raise ValueError(f"unet.width: expected an even number, got {self.width}")
        _at_most(WIDEST, "unet", width=self.width, heads=self.heads, cond_channels=self.cond_channels)
        _at_least(1, "unet.multipliers", levels=len(self.multipliers), smallest=min(self.multipliers, default=1))


@dataclass(frozen=True)
class DetailConfig:
    """The finer final step: a small full-resolution network after the decoder. Width 0 leaves it out (the paper)."""

    width: int = 24


PREDICTIONS = ("x0", "eps", "v")  # what a denoiser may be trained to predict


OBJECTIVES = ("completion", "eq8")


@dataclass(frozen=True)
class SamplerConfig:
    """How stage two samples by default."""

    prediction: str = "x0"  # what the U-Net predicts: "x0" (the paper's x_theta, Eq. 9), "eps" or "v"
    objective: str = "completion"  # of its training: "eq8" as the paper has it, or what one step must get right
    steps: int = 1
    samples: int = 4
    eta: float = 0.0  # noise that each step adds: 0 is DDIM, 1 with all steps the paper's DDPM (Sec. III)

    def __post_init__(self) -> None:
        _at_least(1, "sampler", steps=self.steps, samples=self.samples)
        if not 0 <= self.eta <= 1:
            raise ValueError(f"sampler.eta: expected a number from 0 to 1, got {self.eta}")
        if self.objective not in OBJECTIVES:
            raise ValueError(f"unknown sampler.objective {self.objective!r}; choose one of {', '.join(OBJECTIVES)}")
        if self.prediction not in PREDICTIONS:
            raise ValueError(f"unknown sampler.prediction {self.prediction!r}; choose one of {', '.join(PREDICTIONS)}")


@dataclass(frozen=True)
class StdConfig:
    """How the spread over samples becomes an expected error, per branch: sqrt((base * depth)^2 + (factor * spread)^2).

    The defaults leave the spread as it is.
    """

    base: tuple[float, float] = (0.0, 0.0)  # optical, geometric; a share of the depth
    factor: tuple[float, float] = (1.0, 1.0)
    kept: float = 0.0  # of readings that were kept, a share of the depth
    missed: float = 0.0  # of readings that were kept on glass

    def __post_init__(self) -> None:
        if not len(self.base) == len(self.factor) == 2:
            raise ValueError(
                f"std: expected a base and a factor for each of 2 branches, got {self.base}, {self.factor}"
            )


@dataclass(frozen=True)
class Config:
    """The whole system. ``size`` is the working size (height, width), both multiples of 32."""

    name: str = "lite"
    size: tuple[int, int] = (192, 256)
    window: int = 192  # side of the optical branch's windows; 0: it sees the whole frame (the paper)
    region: RegionConfig = field(default_factory=RegionConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    unet: UNetConfig = field(default_factory=UNetConfig)
    detail: DetailConfig = field(default_factory=DetailConfig)
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    std: StdConfig = field(default_factory=StdConfig)
    evidence: bool = True  # show in-region readings, flagged as unreliable, to the optical branch and the final step

    def __post_init__(self) -> None:
        stride = max(32, 4 * 2 ** (len(self.unet.multipliers) - 1))  # of latents, 4, doubled by each further level
        if len(self.size) != 2 or any(n < stride or n % stride for n in self.size):
            raise ValueError(f"size: expected (height, width), both multiples of {stride}, got {self.size}")
        if self.window and (self.window < stride or self.window % stride):
            raise ValueError(f"window: expected 0 or a multiple of {stride}, got {self.window}")
        colour = self.unet.colour_channels
        if tuple(colour) not in ((), COLOUR_CHANNELS):
            raise ValueError(f"unet.colour_channels: expected () or {COLOUR_CHANNELS}, got {colour}")
        _at_most(self.schedule.timesteps, "sampler", steps=self.sampler.steps)
        if self.unet.anchor and self.sampler.prediction != "x0":
            raise ValueError(f"sampler.prediction {self.sampler.prediction!r} needs unet.anchor=false")

    def look(self, scale: float | None = None) -> tuple[int, int]:
        """Return the size (H, W) of a look of stage one; by default of the first, the one that it is trained for.

        Raises:
            ValueError: for a size that the pretrained encoder's levels do not halve evenly.
        """
        scale = self.refine.looks[0] if scale is None else scale
        seen, coarsest = (round(scale * self.size[0]), round(scale * self.size[1])), 2**self.region.levels
        if self.region.colour == "pretrained" and any(n % coarsest for n in seen):
            raise ValueError(
                f"refine.looks {scale:g} times size {self.size} is {seen}: stage one, with region.levels "
                f"{self.region.levels}, sees multiples of {coarsest}"
            )
        return seen


PRESETS: dict[str, Config] = {
    "tiny": Config(
        name="tiny",
        size=(64, 96),
        window=64,
        region=RegionConfig(width=8, levels=3, colour="scratch"),
        autoencoder=AutoencoderConfig(codes=64, width=8),
        unet=UNetConfig(width=8, cond_channels=8, heads=2, colour_channels=()),
        detail=DetailConfig(width=8),
    ),
    "lite": Config(
        region=RegionConfig(levels=5, attention=2, blocks=1),
        refine=RefineConfig(  # threshold and temperature, as std: on validation scenes
            looks=(1.5, 1.0, 2.0), threshold=0.4, median=3, dilate=3, iterations=1, temperature=1.2812
        ),
        std=StdConfig(base=(0.0641, 0.0161), factor=(6.119, 7.1056), kept=0.0172, missed=0.147),
    ),
    "paper": Config(
        name="paper",
        size=(736, 1280),  # 1280 x 720 (Table VI), padded to a multiple of 32
        window=0,
        region=RegionConfig(
            width=16, levels=4, colour="scratch"
        ),  # of all powers of two nearest to the 16 GFLOPs of Table VI
        autoencoder=AutoencoderConfig(latent_channels=3, codes=8192, width=128, multipliers=(2, 4), res_blocks=2),
        unet=UNetConfig(width=64, block="plain", cond_channels=64, heads=1, anchor=False, colour_channels=()),
        detail=DetailConfig(width=0),
        sampler=SamplerConfig(prediction="x0", objective="eq8", steps=1000, samples=1, eta=1.0),
        evidence=False,
    ),
}


def preset(name: str) -> Config:
    """Return the preset called ``name``.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]


def check_stage_one(threshold: float | None, refine: RefineConfig | None, own: RefineConfig) -> None:
    """Refuse what cannot be asked of stage one in a call.

    Args:
        threshold: of the probability.
        refine: for its kernels.
        own: the system's; only with its threshold, temperature and looks, or with the defaults, is ``refine`` taken,
            since it changes none of them.

    Raises:
        ValueError: for a threshold that is no probability, kernels of another kind, or settings without effect.
    """
    if threshold is not None and not (isinstance(threshold, Real) and 0 < threshold < 1):
        raise ValueError(f"threshold: expected a probability between 0 and 1, got {threshold!r}")
    if refine is not None and not isinstance(refine, RefineConfig):
        raise ValueError(f"refine: expected a config.RefineConfig, got {refine!r}")
    for name in ("threshold", "temperature", "looks") if refine else ():
        asked = getattr(refine, name)
        if asked not in (getattr(own, name), getattr(RefineConfig(), name)):
            how = "give threshold=... beside it" if name == "threshold" else "build a Ditr whose configuration has it"
            raise ValueError(f"refine is asked for its kernels alone, and its {name} {asked} would do nothing: {how}")


def to_dict(config: Any) -> dict[str, Any]:
    """Return ``config`` as nested plain dictionaries, ready for JSON."""
    return asdict(config)


def from_dict(values: dict[str, Any]) -> Config:
    """Rebuild a :class:`Config` from :func:`to_dict`'s result (lists become tuples again).

    Raises:
        ValueError: for a key that no configuration has.
    """
    return _build(Config, values)


def override(config: Config, **settings: Any) -> Config:
    """Return a copy with dotted settings replaced, e.g. ``override(c, **{"unet.width": 48})``.

    Values that come as text (from a command line) are converted to the type of the setting they replace.

    Raises:
        ValueError: for an unknown setting, a value of the wrong type, or a system that cannot be.
    """
    values = to_dict(config)
    for key, value in settings.items():
        _override(values, config, key.split("."), value, key)
    return _build(type(config), values)  # at once: some settings are right only together


def _override(values: dict[str, Any], node: Any, path: list[str], value: Any, key: str) -> None:
    known = [f.name for f in fields(node)] if is_dataclass(node) else []
    if path[0] not in known:
        raise ValueError(f"unknown setting {key!r}; {type(node).__name__} has {', '.join(known) or 'no settings'}")
    old = getattr(node, path[0])
    if len(path) > 1:
        return _override(values[path[0]], old, path[1:], value, key)
    if is_dataclass(old):
        raise ValueError(f"setting {key!r} is a group; set one of {', '.join(key + '.' + f.name for f in fields(old))}")
    values[path[0]] = _convert(value, old, get_type_hints(type(node))[path[0]], key)


def _convert(value: Any, old: Any, kind: Any, key: str) -> Any:
    try:
        if isinstance(old, bool):
            return {"true": True, "1": True, "false": False, "0": False}[str(value).lower()]
        if isinstance(old, tuple):
            parts = [p for p in value.split(",") if p] if isinstance(value, str) else value
            return tuple(_number(p, get_args(kind)[0]) for p in parts)  # as declared: the old one may be empty
        return _number(value, type(old))
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"setting {key!r} expects {type(old).__name__} like {old!r}, got {value!r}") from None


def _number(value: Any, kind: type) -> Any:
    if kind is int and int(value) != float(value):
        raise ValueError
    return kind(value)


def _is_like(value: Any, current: Any) -> bool:
    """Return whether a value has the type of a setting: JSON's list may be a tuple, a whole number may be a float."""
    if is_dataclass(current):
        return isinstance(value, dict)
    if isinstance(current, tuple):
        return isinstance(value, list | tuple) and all(_is_like(v, current[0]) for v in value) if current else True
    if isinstance(current, bool) or isinstance(value, bool):
        return isinstance(value, bool) and isinstance(current, bool)
    return isinstance(value, int | float if isinstance(current, float) else type(current))


def _build(kind: type, values: dict[str, Any]) -> Any:
    known = {f.name: f for f in fields(kind)}
    unknown = set(values) - set(known)
    if unknown:
        raise ValueError(f"{kind.__name__} has no setting {', '.join(sorted(unknown))}")
    default = kind()
    built = {}
    for name, value in values.items():
        current = getattr(default, name)
        if not _is_like(value, current):
            raise ValueError(f"{kind.__name__}.{name} should be like {current!r}, got {value!r}")
        built[name] = _build(type(current), value) if is_dataclass(current) else value
        if isinstance(current, tuple):
            built[name] = tuple(value)
    return kind(**built)
