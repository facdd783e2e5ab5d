"""A run's last whole checkpoint, ready to act: what evaluation, videos and analyses begin with."""

from dataclasses import dataclass

from rtc_mjx import dataset
from rtc_mjx.config import Config
from rtc_mjx.learner import Learner
from rtc_mjx.models import Networks
from rtc_mjx.runs import Run
from rtc_mjx.updates import start_shapes


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
    """Loads the run's last whole checkpoint.

    Raises:
        UsageError: it has none; or the recordings it learned from are not there any more.
    """
    config = run.config
    run.check_recordings()
    learner = config.learner(dataset.statistics(config.scene, dataset.demonstrations(config.scene, config.experts.train, dataset.TRAIN)))
    update, state, _ = run.restore(start_shapes(learner, config.all_seeds))
    return Trained(config, learner, state.networks, update)
