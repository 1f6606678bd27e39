from adaptune.reference import check
from adaptune.tuning.studies import ROLES


def test_the_comment_on_the_length_is_the_rule():
    said = ROLES["sub_trajectory",]
    long = " or ".join(str(length) for length, n in check.LENGTHS.items() if n == 8)
    assert f"{long} where the path of the test is 8 times as long, else 5.0 or less" in said
    assert f"longer where that lasts less than {check.LEAST_SECONDS:g} s" in said
