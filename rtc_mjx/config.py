"""The settings of a run: defaults < configs/<scene>.toml < command line; every run writes what came out, and it is read back here.

Settings are frozen dataclasses; tyro turns them into options (`--losses.adversarial 0.5`). A [methods.NAME] table of a TOML file
holds what differs for one method.
"""

import argparse
import contextlib
import dataclasses
import io
import json
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import tyro

from rtc_mjx.cluster import Hardware
from rtc_mjx.errors import UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.learner import Learner, OptimiserOptions
from rtc_mjx.losses import LossWeights
from rtc_mjx.methods import METHODS, method_name
from rtc_mjx.models import ModelOptions, Statistics
from rtc_mjx.scenes import DoubleGoal, Scene, scene_type


@dataclass(frozen=True)
class Experts:
    """Demonstrations.

    Attributes:
        train: how many to learn from.
        test: how many to compare with during training and in `evaluate`.
    """

    train: int = 8192
    test: int = 2048


@dataclass(frozen=True)
class Intervals:
    """Numbers of updates between events; `test` and `save` are multiples of `log`.

    Attributes:
        log: a line of metrics.
        test: the scene's metrics on test episodes.
        save: a checkpoint.
    """

    log: int = 100
    test: int = 500
    save: int = 500


@dataclass(frozen=True)
class Config:
    """Everything that determines a training.

    Attributes:
        scene: settings of the scene.
        method: which method.
        seeds: how many trainings at once, in one program.
        first_seed: the seed of the first; the others follow.
        updates: length of the training.
        batch: episodes of a minibatch.
        encoder_share: share of the minibatch that takes types from the encoder, where a method has both (the paper's f).
        run: directory of the run; runs/<scene>/<method> if not given.
        resume: go on with the run in that directory.
        model: networks and types.
        losses: weights.
        optimiser: gradients and rates.
        experts: demonstrations.
        every: intervals.
        hardware: where it runs; it is not written down, since no result depends on it.
    """

    scene: Scene = field(default_factory=DoubleGoal)
    method: str = "rtc_c"
    seeds: int = 1
    first_seed: int = 0
    updates: int = 4000
    batch: int = 64
    encoder_share: float = 0.5
    run: Path | None = None
    resume: bool = False
    model: ModelOptions = ModelOptions()
    losses: LossWeights = LossWeights()
    optimiser: OptimiserOptions = OptimiserOptions()
    experts: Experts = Experts()
    every: Intervals = Intervals()
    hardware: Annotated[Hardware, tyro.conf.arg(name="")] = Hardware()

    @property
    def folder(self) -> Path:
        """The run directory."""
        return self.run or Path("runs") / self.scene.name / self.method

    @property
    def all_seeds(self) -> range:
        """The seeds that are trained."""
        return range(self.first_seed, self.first_seed + self.seeds)

    def learner(self, statistics: Statistics) -> Learner:
        """What these settings train, given the statistics of its demonstrations."""
        method = METHODS[self.method]
        return Learner(
            scene=self.scene,
            method=method,
            space=method.space(self.model, self.scene.labels),
            statistics=statistics,
            model=self.model,
            weights=self.losses,
            optimiser=self.optimiser,
            updates=self.updates,
            batch=self.batch,
            encoder_share=self.encoder_share,
        )


LEAST = {
    **dict.fromkeys(("updates", "seeds", "every.log", "every.test", "every.save", "scene.steps", "scene.road_users"), 1),
    **{f"model.{name}": 1 for name in ("width", "discriminator_width", "depth", "mixture", "type_size")},
    **dict.fromkeys(("model.prior_components", "model.posterior_components"), 1),
    **dict.fromkeys(("batch", "experts.train", "experts.test"), 4),
    **dict.fromkeys(
        (
            "first_seed",
            "losses.adversarial_start",
            "losses.adversarial_ramp",
            "losses.policy_gradient_start",
            "losses.policy_gradient_ramp",
            "losses.type_kl_ramp",
            "optimiser.discriminator_steps",
        ),
        0,
    ),
    "model.type_count": 2,
}
POSITIVE = (
    "model.smallest_scale",
    "optimiser.learning_rate",
    "optimiser.prior_rate",
    "optimiser.discriminator_rate",
    "optimiser.value_rate",
    "optimiser.clip",
    "optimiser.trajectory_clip",
)
NOT_NEGATIVE = tuple(f"losses.{f.name}" for f in dataclasses.fields(LossWeights) if f.type is float or f.type == "float")
OF_VALUE = (  # read by methods with a V, and by no other
    *("losses.policy_gradient", "losses.policy_gradient_start", "losses.policy_gradient_ramp", "losses.value"),
    *("optimiser.value_rate", "optimiser.discount", "optimiser.trace"),
)
SHARES = (
    "encoder_share",
    "optimiser.final_rate",
    "optimiser.decay",
    "optimiser.discount",
    "optimiser.trace",
    "scene.lower_probability",
    "scene.train_share",
)


def configs() -> Path:
    """The folder of committed settings: beside the package in a checkout, inside it in an installed wheel."""
    inside = Path(str(resources.files("rtc_mjx"))) / "configs"
    return inside if inside.is_dir() else Path(__file__).resolve().parents[1] / "configs"


def from_command_line(argv: Sequence[str], prog: str) -> Config:
    """The settings of a training.

    Raises:
        UsageError: an unknown option or name, or a value of the wrong type or out of range; one line.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    first.add_argument("--scene", default=None)
    first.add_argument("--method", default=None)
    first.add_argument("--run", type=Path, default=None)
    first.add_argument("--resume", action="store_true")
    try:
        given, _ = first.parse_known_args(list(argv))
    except argparse.ArgumentError as error:
        raise UsageError(f"{prog}: {error}") from error
    if given.resume:
        return _resumed(given, list(argv), prog)
    config = defaults(given.scene or "double_goal", method_name(given.method or Config.method))
    return check(_parse(config, _without(argv, "--scene", "--method"), prog))


def defaults(scene: str, method: str) -> Config:
    """The settings of a scene and a method, as committed."""
    config = Config(scene=scene_type(scene)(), method=method)
    file = configs() / f"{config.scene.settings or scene}.toml"
    if not file.is_file():
        return config
    try:
        table = tomllib.loads(file.read_text())
    except ValueError as error:  # not TOML, or not text
        raise UsageError(f"{file}: {error}") from error
    by_method = table.pop("methods", {})
    for name, held in by_method.items() if isinstance(by_method, Mapping) else [("methods", by_method)]:
        if not isinstance(held, Mapping):
            raise UsageError(f"{file}: '{name}' is a table, got {held!r}")
        if name not in METHODS:
            raise UsageError(f"{file}: [methods.{name}]: no such method; there are {', '.join(METHODS)}")
    for held in (table, *by_method.values()):
        for key in ("method", "run", "resume", "hardware"):
            if key in held:
                raise UsageError(f"{file}: '{key}' is chosen on the command line")
    merged = merge(merge(config, table, str(file)), by_method.get(method, {}), f"{file} [methods.{method}]")
    try:
        return check_values(merged)
    except UsageError as error:
        raise UsageError(f"{file}: {error}") from error


def _resumed(given: argparse.Namespace, argv: list[str], prog: str) -> Config:
    """The settings of the run that is resumed; what the command line says as well must agree."""
    folder = given.run
    if folder is None and given.scene and given.method:
        folder = Config(scene=scene_type(given.scene)(), method=method_name(given.method)).folder
    if folder is None:
        raise UsageError("--resume: say which run with --run DIR")
    held = read(folder)
    if given.scene and given.scene != held.scene.name:
        raise UsageError(f"--scene {given.scene}: the run in {folder} is of scene {held.scene.name}")
    if given.method and method_name(given.method) != held.method:
        raise UsageError(f"--method {given.method}: the run in {folder} is of method {held.method}")
    wanted = check(_parse(dataclasses.replace(held, run=folder, resume=True), _without(argv, "--scene", "--method"), prog))
    ours, theirs = flat(to_dict(wanted)), flat(to_dict(held))
    for name in ours:
        if ours[name] != theirs[name] and name not in ("run", "resume"):
            raise UsageError(
                f"--{name} {ours[name]}: the run in {folder} has {theirs[name]}; resume without the option, or start a new run"
            )
    return wanted


def _without(argv: Sequence[str], *options: str) -> list[str]:
    """The arguments without these options and their values."""
    left, skip = [], False
    for word in argv:
        if skip or word.split("=")[0] in options:
            skip = not skip and "=" not in word
            continue
        left.append(word)
    return left


def _parse(config: Config, argv: list[str], prog: str) -> Config:
    """Tyro's parse; its boxed messages become one line."""
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(Config, prog=prog, description=DESCRIPTION, default=config, args=argv, config=(tyro.conf.AvoidSubcommands,))
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UsageError(_one_line(told.getvalue(), prog)) from None


DESCRIPTION = """Trains a method on a scene. `--scene NAME` and `--method NAME` choose; all else has a default (configs/<scene>.toml)."""


def _one_line(boxed: str, prog: str) -> str:
    """The first message of tyro's box, with the option it suggests."""
    lines = [line.strip("│╭╮╰╯ ").strip() for line in boxed.splitlines()[1:]]
    rule = next((i for i, line in enumerate(lines) if set(line) <= {"─"}), len(lines))
    message = " ".join(lines[:rule]) or boxed.strip()
    options = [line.split()[0] for line in lines[rule:] if line.startswith("--")]
    near = f"; near it: {', '.join(dict.fromkeys(options[:3]))}" if "nrecognized" in message and options else ""
    return f"{prog}: {message}{near} (see --help)"


def merge(settings: Any, table: Mapping[str, Any], where: str) -> Any:
    """The dataclass with the fields that a TOML table names replaced.

    Raises:
        UsageError: no such field, or a value of another type; the message names file, key and what is accepted.
    """
    hints = typing.get_type_hints(type(settings))
    changed = {}
    for key, value in table.items():
        held = getattr(settings, key, None)
        if key not in {f.name for f in dataclasses.fields(settings)}:
            raise UsageError(f"{where}: unknown key '{key}'; there are {', '.join(f.name for f in dataclasses.fields(settings))}")
        if dataclasses.is_dataclass(held):
            if not isinstance(value, Mapping):
                raise UsageError(f"{where}: '{key}' is a table, got {value!r}")
            changed[key] = merge(held, value, f"{where} [{key}]")
        else:
            changed[key] = _typed(value, hints[key], f"{where}: '{key}'")
    return dataclasses.replace(settings, **changed)


def _typed(value: Any, kind: Any, where: str) -> Any:
    """The value as the type that a field has."""
    options = typing.get_args(kind)
    if typing.get_origin(kind) is typing.Literal:
        if value in options:
            return value
        raise UsageError(f"{where} is {value!r}; accepted are {', '.join(map(repr, options))}")
    if isinstance(kind, types.UnionType):
        if value is None:
            return None
        kind = next(k for k in options if k is not types.NoneType)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is kind:
        return value
    raise UsageError(f"{where} is {value!r}; a value of type {kind.__name__} is needed")


def check(config: Config) -> Config:
    """The settings, if every value is in its range, they fit each other, and the method can run on the scene.

    Raises:
        UsageError: the first that is not; one line with its option and what is accepted.
    """
    config = check_values(config)
    if METHODS[config.method].kind == "label":
        config = dataclasses.replace(config, scene=config.scene.labelled)
    if METHODS[config.method].kind == "label" and not config.scene.labels:
        raise UsageError(f"--method {config.method}: scene {config.scene.name} {config.scene.unlabelled}")
    return config


def check_values(config: Config) -> Config:
    """The settings, if every value is in its range and they fit each other.

    Raises:
        UsageError: the first that is not; one line with its option and what is accepted.
    """
    config.hardware.check()
    values = flat(to_dict(config))
    for name, value in values.items():
        option = f"--{name.replace('_', '-')} {value}"
        if isinstance(value, float) and value != value:
            raise UsageError(f"{option}: a number is needed")
        if name in LEAST and value < LEAST[name]:
            raise UsageError(f"{option}: at least {LEAST[name]} is needed")
        if name in POSITIVE and not 0 < value < float("inf"):
            raise UsageError(f"{option}: a positive number is needed")
        if name in NOT_NEGATIVE and not 0 <= value < float("inf"):
            raise UsageError(f"{option}: a number from 0 on is needed")
        if name in SHARES and not 0 <= value <= 1:
            raise UsageError(f"{option}: a number between 0 and 1 is needed")
    for name in ("test", "save"):
        if values[f"every.{name}"] % config.every.log:
            raise UsageError(f"--every.{name} {values[f'every.{name}']}: a multiple of --every.log {config.every.log} is needed")
    if config.first_seed + config.seeds > 2**31:
        raise UsageError(f"--first-seed {config.first_seed}: seeds below {2**31} are needed")
    split = round(config.batch * config.encoder_share)
    shares = {b.share for b in METHODS[method_name(config.method)].branches}
    if "rest" in shares and not 0 < split < config.batch:
        raise UsageError(f"--encoder-share {config.encoder_share}: of a batch of {config.batch} both parts need an episode")
    return dataclasses.replace(config, method=method_name(config.method))


def to_dict(config: Config) -> dict[str, Any]:
    """The settings as JSON holds them; the scene by name and settings, without what only places the run."""
    table = dataclasses.asdict(config)
    table["scene"] = {"name": config.scene.name, **table["scene"]}
    table["run"], table["resume"] = None, False
    del table["hardware"]
    return table


def flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name."""
    out: dict[str, Any] = {}
    for key, value in table.items():
        out |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return out


def write(config: Config, folder: Path) -> None:
    """Writes config.json."""
    write_whole(folder / "config.json", json.dumps(to_dict(config), indent=1) + "\n")


SEEDS = ("seeds", "first_seed")  # which trainings; all other settings say what each of them does


def differing(ours: Config, theirs: Config) -> list[tuple[str, Any, Any]]:
    """The settings in which two runs differ, of those that the method of the second reads, with the values of both."""
    one, other = (flat(to_dict(held)) for held in (ours, theirs))
    return [(name, one[name], other.get(name)) for name in one if one[name] != other.get(name) and name not in unread(theirs.method)]


def unread(method: str) -> frozenset[str]:
    """Settings that a method does not read: two runs of it that differ in these are alike."""
    return frozenset() if "value" in METHODS[method_name(method)].parts else frozenset(OF_VALUE)


def later(method: str) -> frozenset[str]:
    """Settings that a run may lack since they came later: those its method does not read, and one whose default is what was before."""
    return unread(method) | {"model.posterior_components"}


def read(folder: Path) -> Config:
    """The settings of a run directory.

    Raises:
        UsageError: there is no run, or its config.json is damaged or of another version.
    """
    file = folder / "config.json"
    if not file.is_file():
        raise UsageError(f"{folder} is not a run directory: it has no config.json")
    try:
        table = json.loads(file.read_text())
        scene = dict(table["scene"])
        config = Config(scene=merge(scene_type(scene.pop("name"))(), scene, f"{file} [scene]"))
        config = merge(config, {**table, "scene": {}}, str(file))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise error if isinstance(error, UsageError) else UsageError(f"{file} is damaged: {error}") from error
    absent = [name for name in flat(to_dict(config)) if name not in {*flat(table), *later(config.method)}]
    if absent:  # today's default would not be what the run was made with
        raise UsageError(f"{file} lacks {', '.join(absent)}: it is damaged or of another version of rtc_mjx")
    return check(dataclasses.replace(config, run=folder))
