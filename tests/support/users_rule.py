"""Selection rules as a user may write them."""

from adaptune.model import Rule
from adaptune.model.rules import NOTHING
from adaptune.space import Selection


class Cheapest(Rule):
    sentence = "the set that costs least, wherever it is"

    def fit(self, data):
        self.sets, costs = data.sets, data.costs
        self.best = min(data.candidates or data.sets, key=costs.alone)
        return self

    def select(self, feature, evidence=NOTHING):  # noqa: ARG002
        return Selection(self.best, self.sets[self.best], predicted_error=1.0)


class Outside(Cheapest):
    def fit(self, data):
        super().fit(data)
        self.best = next(trial for trial in data.sets if trial not in data.candidates)
        return self


class NoSelf(Cheapest):
    def fit(self, data):
        super().fit(data)


class Empty(Cheapest):
    def select(self, feature, evidence=NOTHING):
        pass


class Number(Cheapest):
    def select(self, feature, evidence=NOTHING):  # noqa: ARG002
        return 3


class Unknown(Cheapest):
    def select(self, feature, evidence=NOTHING):
        return super().select(feature, evidence)._replace(trial=999)


class OtherValues(Cheapest):
    def select(self, feature, evidence=NOTHING):
        return super().select(feature, evidence)._replace(parameters={"voxel": 1.9})


class Weights(Cheapest):
    gives_weights = True

    def select(self, feature, evidence=NOTHING):
        selection = super().select(feature, evidence)
        return selection._replace(weights={77: 1.0})


class OneArgument(Cheapest):
    def select(self, feature):
        return super().select(feature)


class Maker(Cheapest):
    def __init__(self, k):
        self.k = k


class Raises(Cheapest):
    def fit(self, data):
        return data.nothing


class Other:
    pass
