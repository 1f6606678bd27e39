from adaptune.commands.online import now
from adaptune.runs.record import Choice, Run
from adaptune.space import Selection

SET = Selection(7, {"voxel_size": 0.5})


def test_a_drive_is_told_in_a_few_words():
    run = Run(rate=1.0)
    assert now(run) == ""
    run.newest = Choice(0, SET._replace(estimated_error=0.5), 0.01)
    assert now(run) == "trial 7, error 0.50 %"
    run.dropped = 3
    run.newest = Choice(1, SET._replace(state="lost"), 0.01)
    assert now(run) == "3 dropped, trial 7, lost: do not rely on the pose"
