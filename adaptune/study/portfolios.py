"""The sets of a study's portfolios."""

from itertools import chain, zip_longest

from adaptune.odometry.portfolio import PortfolioError, path_of, read_portfolio
from adaptune.odometry.registry import ODOMETRIES, odometry_class
from adaptune.space import ODOMETRY, ParameterSet, ParameterSpace, PooledSpace
from adaptune.study.config import StudyConfig


def portfolio_sets(
    config: StudyConfig, space: ParameterSpace
) -> tuple[tuple[ParameterSet, ...], list[str]]:
    """The sets of all portfolios without the baselines, and what must be said of them.

    Of several odometries, each one's first sets come in turn. A portfolio that has changed since
    the study began is not used. There is an AdaptuneError if one is of another odometry.
    """
    said, of_each = list[str](), list[list[ParameterSet]]()
    for name, digest in config.portfolios.items():
        portfolio, path = read_portfolio(name), path_of(name)
        label = next((k for k, v in config.odometries.items() if v.name == portfolio.odometry), "")
        if not label:
            what = f"is of {portfolio.odometry}, and tuned is {', '.join(config.odometries)}"
            raise PortfolioError(f"{path}: odometry: {what}; name another portfolio")
        if portfolio.digest != digest:
            what = "is not the one that this study began with, and is not used"
            said.append(f"{path} {what}: {portfolio.digest}, not {digest}")
            continue
        one = config.odometries[label]
        own = space.spaces[label] if isinstance(space, PooledSpace) else space
        known = {*own.names, *(one.declared[1].space or own).names}
        known |= {*odometry_class(one.name).space.names} if one.name in ODOMETRIES else set()
        try:
            sets, more = portfolio.fitting(own, known)
        except PortfolioError as error:
            raise PortfolioError(f"{path}: {error}") from error
        said += [f"{path}: {what}" for what in more]
        pooled = isinstance(space, PooledSpace)
        of_each.append([{ODOMETRY: label, **one} for one in sets] if pooled else sets)
    turns = chain.from_iterable(zip_longest(*of_each))
    return tuple(one for one in turns if one is not None), said
