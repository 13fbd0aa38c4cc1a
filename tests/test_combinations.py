"""Sets of effects in one linear model, against least squares of their own and against enumeration."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from estimator.discrepancy.combinations import (
    PER_DIRECTION,
    PER_NAME,
    Candidate,
    LinearLibrary,
    price,
    visible_directions,
)
from estimator.effects.declaration import EffectInstance, Parameter, Search


def effect(name: str, count: int, *, nominal: float | None = None, low: float = -1e4, high: float = 1e4,
           search: bool = False) -> EffectInstance:
    parameters = [Parameter(f"p{i}", "1", 1.0, (low, high), nominal=nominal) for i in range(count)]
    if search:
        parameters.append(Parameter("time", "s", 1.0, (0.0, 9.0), search=Search(1.0, 8.0, 4, "linear")))
    return EffectInstance(name, name, "doppler", tuple(parameters), lambda sample, p: p, "p = 0", "none")


def library_of(blocks: list[tuple[EffectInstance, np.ndarray]], residual: np.ndarray) -> LinearLibrary:
    columns = np.concatenate([b for _, b in blocks], axis=1)
    gram, right = columns.T @ columns, -columns.T @ residual
    candidates, start = [], 0
    for declared, block in blocks:
        width = block.shape[1]
        inside = slice(start, start + width)
        nominal = None
        if declared.parameters[0].nominal is not None:
            nominal = np.full(width, declared.parameters[0].nominal)
        candidates.append(Candidate(declared, np.zeros(len(declared.parameters)), np.arange(width),
                                    np.arange(start, start + width),
                                    visible_directions(gram[inside, inside], gram[inside, inside]), nominal))
        start += width
    return LinearLibrary(candidates, gram, right)


def drop_of(blocks: list[np.ndarray], residual: np.ndarray) -> tuple[float, np.ndarray]:
    columns = np.concatenate(blocks, axis=1)
    solution = np.linalg.lstsq(columns, -residual, rcond=None)[0]
    return float(residual @ residual - np.sum((residual + columns @ solution) ** 2)), solution


@pytest.mark.parametrize("seed", range(4))
def test_a_set_explains_what_a_least_squares_fit_with_it_explains(seed: int) -> None:
    draw = np.random.default_rng(seed)
    blocks = [(effect(f"e{k}", 1 + k % 3), draw.standard_normal((80, 1 + k % 3)) * 3) for k in range(5)]
    residual = draw.standard_normal(80) - 4 * blocks[1][1][:, 0] + blocks[3][1][:, 0]
    library = library_of(blocks, residual)
    for chosen in ([0], [1, 3], [4, 0, 2]):
        found = library.explained(chosen)
        drop, solution = drop_of([blocks[i][1] for i in chosen], residual)
        assert found.drop == pytest.approx(drop, rel=1e-6)  # the wide plausible range is a weak prior
        np.testing.assert_allclose(np.concatenate(found.sizes), solution, rtol=1e-5, atol=1e-8)
        cost = sum(PER_NAME + PER_DIRECTION * library.candidates[i].degrees for i in chosen)
        assert found.worth == pytest.approx(drop / 2 - cost, rel=1e-6)
        assert found.plausible
    assert library.explained([]).drop == 0 and library.worth([]) == 0


def test_an_effect_of_known_size_is_taken_at_that_size() -> None:
    draw = np.random.default_rng(7)
    known, other = draw.standard_normal((60, 1)) * 4, draw.standard_normal((60, 2)) * 3
    residual = draw.standard_normal(60) - 1.0 * known[:, 0] + other @ [0.5, -0.4]
    library = library_of([(effect("known", 1, nominal=1.0), known), (effect("other", 2), other)], residual)
    fixed = residual + known[:, 0]
    drop, _ = drop_of([other], fixed)
    expected = float(residual @ residual - fixed @ fixed) + drop
    found = library.explained([0, 1])
    assert found.drop == pytest.approx(expected, rel=1e-6)
    assert found.sizes[0] == pytest.approx([1.0])
    assert price(library.candidates[0].effect, 1) == PER_NAME  # nothing about it is free


def test_implausible_sizes_are_worth_nothing() -> None:
    draw = np.random.default_rng(2)
    block = draw.standard_normal((70, 1)) * 5
    residual = draw.standard_normal(70) - 3.0 * block[:, 0]
    wide, tight = (library_of([(effect("e", 1, low=-limit, high=limit), block)], residual) for limit in (9.0, 1.0))
    assert wide.explained([0]).plausible and wide.worth([0]) > 100
    assert not tight.explained([0]).plausible and tight.worth([0]) == -np.inf


def test_a_direction_that_only_an_impossible_size_would_show_explains_nothing() -> None:
    """Two parameters of nearly the same signature: their difference of plausible size is a hundredth of the noise."""
    draw = np.random.default_rng(4)
    first = draw.standard_normal(200) * 5
    block = np.column_stack([first, first + 0.01 * draw.standard_normal(200)])
    residual = draw.standard_normal(200)
    library = library_of([(effect("pair", 2, low=-0.1, high=0.1), block)], residual)
    assert library.candidates[0].degrees == 2
    assert np.all(np.abs(library.explained([0]).sizes[0]) < 0.1)
    assert library.explained([0]).drop < 4 + 1.5 * drop_of([block[:, :1]], residual)[0]


@pytest.mark.parametrize("seed", range(12))
def test_the_search_reaches_the_best_set_of_an_enumeration(seed: int) -> None:
    """Nine names with much in common and one to three of them true; all sets of up to three are enumerated."""
    draw = np.random.default_rng(100 + seed)
    common = draw.standard_normal((150, 4))
    blocks = []
    for k in range(9):
        width = 1 + k % 3
        blocks.append((effect(f"e{k}", width), common @ draw.standard_normal((4, width))
                       + 0.6 * draw.standard_normal((150, width))))
    residual = draw.standard_normal(150)
    for i in draw.choice(9, int(draw.integers(1, 4)), replace=False):
        residual = residual - blocks[i][1] @ (draw.standard_normal(blocks[i][1].shape[1]) * 1.2)
    library = library_of(blocks, residual)
    best = max(library.worth(s) for n in range(4) for s in combinations(range(9), n))
    found = library.best((), (), 3)
    assert library.worth(found) == pytest.approx(best, abs=1e-9)
    wrong = [int(i) for i in draw.choice(9, 3, replace=False)]
    assert library.worth(library.best(wrong, (), 3)) == pytest.approx(best, abs=1e-9)


def test_excluded_and_refused_sets_are_not_returned() -> None:
    draw = np.random.default_rng(5)
    blocks = [(effect(f"e{k}", 1), draw.standard_normal((90, 1)) * 3) for k in range(4)]
    residual = draw.standard_normal(90) - 3 * blocks[2][1][:, 0] - 2 * blocks[0][1][:, 0]
    library = library_of(blocks, residual)
    assert {library.candidates[i].name for i in library.best((), (), 4)} >= {"e0", "e2"}
    assert "e2" not in {library.candidates[i].name for i in library.best((), ("e2",), 4)}
    first = frozenset(library.candidates[i].name for i in library.best((), (), 4))
    second = frozenset(library.candidates[i].name for i in library.best((), (), 4, [first]))
    assert second != first


def test_company_of_a_look_alike_changes_with_it() -> None:
    """a + b is true; c copies a only together with d in the place of b."""
    draw = np.random.default_rng(9)
    a, b, noise = (draw.standard_normal(300) * 6 for _ in range(3))
    c = a + noise
    d = b - noise * 0.999 + 0.05 * draw.standard_normal(300)
    blocks = [(effect(n, 1), x[:, None]) for n, x in zip("abcd", (a, b, c, d), strict=True)]
    residual = draw.standard_normal(300) - a - b
    library = library_of(blocks, residual)
    assert {library.candidates[i].name for i in library.best((), (), 2)} == {"a", "b"}
    assert library.worth([1, 2]) < library.worth([0, 1]) - 100
    company = library.exchanged([1, 2], {"a"})
    assert {library.candidates[i].name for i in company} == {"c", "d"}
    assert library.worth(company) > library.worth([0, 1]) - 10
    assert 0.4 < library.copied(0, np.array([1.0]), 2) < 0.6
    assert library.copied(0, np.array([1.0]), 1) < 0.05


def test_settings_of_one_name_exclude_each_other() -> None:
    draw = np.random.default_rng(6)
    declared = effect("jump", 1, search=True)
    block = draw.standard_normal((120, 3)) * 4
    blocks = [(declared, block[:, k : k + 1]) for k in range(3)]
    residual = draw.standard_normal(120) - block[:, 1] - 0.6 * block[:, 2]
    library = library_of(blocks, residual)
    assert library.best((), (), 3) == [1] and library.best_setting((), "jump") == 1
    assert price(declared, 1) == pytest.approx(PER_NAME + PER_DIRECTION + np.log(4))
