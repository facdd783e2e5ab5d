"""Which values settings may have, each by itself and together."""

import dataclasses

from rtc_mjx.config.options import Config, flat, to_dict
from rtc_mjx.errors import UsageError
from rtc_mjx.losses import LossWeights
from rtc_mjx.methods import METHODS, method_name

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
            "losses.type_recovery_ramp",
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
SHARES = (
    "encoder_share",
    "optimiser.final_rate",
    "optimiser.decay",
    "optimiser.discount",
    "optimiser.trace",
    "scene.lower_probability",
    "scene.train_share",
)


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
