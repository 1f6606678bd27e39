"""Samplers of the user, in processes of their own, see `adaptune.hosting`."""

import json
from collections.abc import Sequence
from typing import Any, BinaryIO

from adaptune import hosting
from adaptune.odometry.wire import Message, Readable
from adaptune.space import ParameterSet, ParameterSpace
from offline.objective import SamplerResult
from offline.samplers.base import Sampler
from offline.samplers.settings import SERVICE, SamplerError, optuna_class, optuna_sampler


class HostedSampler(Sampler):
    """A sampler of the user; `AskedSampler` asks it in the other process."""

    constrained = True  # the other process sees to constraints

    def __init__(self, space: ParameterSpace, config: Any):
        super().__init__(space, config)
        self._process = hosting.Hosted(SERVICE, config.sampler, "propose")
        self._about = {
            "space": space.dump(),
            "config": config.model_dump(mode="json", exclude={"storage"}),
        }

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:
        try:
            answer = self._process.ask(self._about | {"history": history})
        except hosting.HostError as error:
            trials = f"trials {numbers.start} to {numbers.stop - 1}"
            raise SamplerError(f"offline.sampler, at {trials}: {error}") from error
        sets: list[ParameterSet] = answer.header["sets"]
        return sets


# What follows runs in the other process.


def load(name: str) -> None:
    """Import a sampler."""
    optuna_class(name)


def make(reader: Readable, writer: BinaryIO, name: str) -> None:
    """Make a sampler and say how that went."""

    def answer(message: Message) -> dict[str, Any]:
        optuna_sampler(name, message.header["settings"], message.header["seed"])
        return {}

    hosting.answer_all(reader, writer, answer)


def propose(reader: Readable, writer: BinaryIO, _: str) -> None:
    """Propose one batch after another."""
    from offline.config import OfflineConfig
    from offline.samplers.asked import AskedSampler

    made: dict[str, AskedSampler] = {}

    def answer(message: Message) -> dict[str, Any]:
        about = message.header
        key = json.dumps([about["space"], about["config"]])
        if key not in made:
            space = ParameterSpace.load(about["space"])
            made[key] = AskedSampler(space, OfflineConfig.model_validate(about["config"]))
        history = [
            SamplerResult(set_, tuple(value) if isinstance(value, list) else value, tuple(by))
            for set_, value, by in about["history"]
        ]
        return {"sets": made[key].propose(history)}

    hosting.answer_all(reader, writer, answer)
