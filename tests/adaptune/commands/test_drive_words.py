from adaptune.commands.online import now
from adaptune.space import Selection
from online.replay import Choice, ReplayRecord

SET = Selection(7, {"voxel_size": 0.5})


def test_a_drive_is_told_in_a_few_words():
    record = ReplayRecord(rate=1.0)
    assert now(record) == ""
    record.newest = Choice(0, SET._replace(estimated_error=0.5), 0.01)
    assert now(record) == "trial 7, error 0.50 %"
    record.dropped = 3
    record.newest = Choice(1, SET._replace(state="lost"), 0.01)
    assert now(record) == "3 dropped, trial 7, lost: do not rely on the pose"
