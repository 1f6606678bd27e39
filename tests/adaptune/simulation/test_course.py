import pytest
from pydantic import ValidationError

from adaptune.simulation import Course


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"scenes": ["moon"]}, "no scene 'moon'; choose from cave, corridor, field, garden"),
        ({"scenes": ["cave"], "length": 0}, "greater than or equal to 10"),
        ({"scenes": ["cave"], "sensor": "vlp17"}, "no sensor 'vlp17'; choose from avia, hdl32e"),
        ({"scenes": ["cave"], "rate": 5.0}, "a robot moves too fast for 5 scans a second"),
        ({"scenes": ["cave"], "stamp": "middle"}, "'start' or 'end'"),
        ({"scenes": ["cave"] * 3, "length": 9000.0}, "at most 20000 m"),
    ],
)
def test_bad_input_is_told(given, says):
    with pytest.raises(ValidationError, match=says):
        Course.model_validate(given)


def test_legs_take_the_courses_length_unless_they_have_their_own():
    course = Course.model_validate(
        {"scenes": ["cave", {"scene": "street", "length": 25.0}, {"scene": "open"}], "length": 40.0}
    )
    assert course.legs == [("cave", 40.0), ("street", 25.0), ("open", 40.0)]
    assert course.turns == 10.0
    assert Course(scenes=("cave",), rate=20.0).turns == 20.0
