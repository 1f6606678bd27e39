import signal
from types import SimpleNamespace

import pytest
import requests
from docker.errors import APIError, NotFound

from adaptune.errors import OdometryError
from adaptune.odometry.systems import engine
from adaptune.odometry.systems.engine import Container, EngineError


def answered(status, kind=APIError):
    response = requests.Response()
    response.status_code = status
    return kind("asked", response, f"answer {status}")


@pytest.fixture
def asked(monkeypatch):
    """Ask an engine that raises this error for how a container and its command ended."""

    def ask(error, what):
        def fail(*_):
            raise error

        api = SimpleNamespace(inspect_container=fail, exec_inspect=fail)
        monkeypatch.setattr(engine, "engine", lambda: SimpleNamespace(api=api))
        container = Container.__new__(Container)
        container.image = "mine"
        return container.ended() if what == "container" else container.finished("name")

    return ask


@pytest.mark.parametrize("what", ["container", "command"])
def test_only_what_is_gone_was_killed(asked, what):
    assert asked(answered(404, NotFound), what) == -signal.SIGKILL
    for error in (answered(500), answered(503), requests.exceptions.ReadTimeout("60 s")):
        with pytest.raises(EngineError, match=r"answer 50|does not answer any more"):
            asked(error, what)
    with pytest.raises(OdometryError, match="answer 400") as caught:
        asked(answered(400), what)
    assert not isinstance(caught.value, EngineError)
