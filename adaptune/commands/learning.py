"""The command by which a study learns from its own drives."""

from functools import partial
from typing import Annotated

import typer

from adaptune.commands.options import Folder, Override, StudyFile, load
from adaptune.next_command import say_next_of_study, say_next_of_trained
from adaptune.terminal import progress, say


def learn(
    study: StudyFile,
    drive: Annotated[
        str,
        typer.Argument(
            metavar="DRIVE",
            help="A bag, a folder, or the name of a sequence of the study.",
            show_default=False,
        ),
    ],
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC|FILE|estimated",
            help="The drive's reference.",
            show_default="as of the study's other sequences, or what is found",
        ),
    ] = None,
) -> None:
    """Learn from another drive, and say what has changed.

    Adds the recording to the training sequences, runs the trials that are missing on it, and fits
    again. The study's YAML stays as it is: `learned.yaml` in its folder keeps what was learned, and
    every command knows it. Stop it with Ctrl-C, and run it again to resume.
    """
    loaded = load(study, override, folder)
    from adaptune.model import ErrorModel, ModelError
    from adaptune.study.new_drive import find_drive
    from offline.learn import learn as learn_from

    try:
        trained = ErrorModel.load(loaded.model_path).sequences
    except ModelError:
        trained = []
    found = find_drive(loaded, drive, reference, trained)
    say(found.words)
    with progress() as show:
        lesson = learn_from(loaded, found, partial(load, study, override, folder), show)
    for sentence in lesson.words:
        say(sentence)
    say(f"Learned drives: {loaded.folder / 'learned.yaml'}")
    say(f"Error model: {loaded.model_path}")
    if (loaded.folder / "switching.json").exists():
        why = "the switch cost was measured without this drive"
        say_next_of_study(why, "switching", study, override, folder)
        return
    several, test = bool(lesson.training.model.expected), lesson.study.config.test
    say_next_of_trained(several, test, study, override, folder)
