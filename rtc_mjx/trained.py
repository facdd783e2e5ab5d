"""A run's last whole checkpoint, ready to act: what evaluation, videos and analyses begin with."""

from dataclasses import dataclass

from rtc_mjx import dataset
from rtc_mjx.config import Config
from rtc_mjx.learner import Learner
from rtc_mjx.models import Networks
from rtc_mjx.runs import Run
from rtc_mjx.updates import TrainState, start_shapes


@dataclass(frozen=True)
class Trained:
    """What a run has learned.

    Attributes:
        config: of the run.
        learner: what was trained, with the statistics of its demonstrations.
        networks: of all seeds.
        update: at which they stand.
    """

    config: Config
    learner: Learner
    networks: Networks
    update: int


def trained(run: Run) -> Trained:
    """Loads what the run's last whole checkpoint holds of the networks.

    Raises:
        UsageError: it has none; or the recordings it learned from are not there any more.
    """
    learner, update, state, _ = restored(run)
    return Trained(run.config, learner, state.networks, update)


def restored(run: Run) -> tuple[Learner, int, TrainState, float]:
    """What was trained, and the run's last whole checkpoint: its update, its state, and the seconds spent until then.

    Raises:
        UsageError: it has none; or the recordings it learned from are not there any more.
    """
    config = run.config
    run.check_recordings()
    learner = config.learner(dataset.statistics(config.scene, dataset.demonstrations(config.scene, config.experts.train, dataset.TRAIN)))
    return learner, *run.restore(start_shapes(learner, config.all_seeds))
