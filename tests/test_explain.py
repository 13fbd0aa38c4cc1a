"""The whole workflow on campaigns with hidden effects: what it says, and what it must not say."""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from estimator.effects.declaration import EffectInstance, Parameter
from problems.alignment import next_measurement
from problems.alignment.campaign import Campaign
from problems.alignment.commands_explain import explain
from problems.alignment.explain_answer import Explanation, answer_of, text_of
from problems.alignment.explain_report import page_of
from problems.alignment.explanation import explained
from problems.alignment.problem import alignment_model, alignment_problem
from problems.alignment.simulator import preset, simulate
from problems.readers.campaign_file import write_campaign

HEAVY = ("flexible-appendage", "propellant-slosh")  # left out where a test is not about them, to save time
app = typer.Typer()
app.command()(explain)


def compact(seed: int, effects: Any = None, **changes: Any) -> Campaign:
    return simulate(preset("compact", **changes), seed, effects)[0]


@functools.cache
def hidden(which: int) -> tuple[Explanation, dict[str, tuple[float, ...]]]:
    """Campaigns with effects that are drawn here and that the code under test is not told."""
    draw = np.random.default_rng([2024, which])
    truths: list[dict[str, tuple[float, ...]]] = [
        {"beam-mispointing:1": tuple(draw.choice([-1, 1], 2) * draw.uniform(5e-5, 9e-5, 2)),
         "residual-magnetic-dipole": tuple(draw.uniform(1.0, 2.0, 3) * draw.choice([-1, 1], 3))},
        {"gravity-gradient-torque": (1.0,)},
    ]
    truth = truths[which]
    return explained(compact(40 + which, {n: list(v) for n, v in truth.items()}), without=HEAVY), truth


@pytest.mark.parametrize("which", [0, 1])
def test_hidden_effects_are_named_with_their_size(which: int) -> None:
    explanation, truth = hidden(which)
    answer = answer_of(explanation)
    assert answer["verdict"] in ("named", "ambiguous"), answer["why"]
    assert len(answer["effects"]) == len(truth)
    for name, values in truth.items():
        entry = next(e for e in answer["effects"] if name in e["group"])
        if entry["name"] != name:
            continue
        for (key, fitted), true in zip(entry["parameters"].items(), values, strict=True):
            assert abs(fitted["value"] - true) < 4 * fitted["sigma"], (name, key)
        assert entry["held_out_after"] < entry["held_out_before"]
        assert entry["held_out_after"] == pytest.approx(1.0, abs=0.1)
        assert entry["p_value_after_search"] < 0.01
    assert [e["name"] for e in answer["effects"]] == list(explanation.accepted)
    assert not explanation.findings.after.present


def test_a_known_size_is_confirmed_and_what_it_moved_is_said() -> None:
    explanation, _ = hidden(1)
    effect = answer_of(explanation)["effects"][0]
    assert effect["name"] == "gravity-gradient-torque" and effect["group"] == ["gravity-gradient-torque"]
    # Without its torque the tensor of inertia is biased by far more than its sigma.
    assert effect["moved_sigma"]["normalized_inertia"] > 10
    miss = effect["held_out"]["star_tracker"]
    assert miss["unit"] == "arcsec" and miss["before"] > 2 * miss["floor"]
    assert miss["after"] == pytest.approx(miss["floor"], rel=0.1)


def test_a_quiet_campaign_is_quiet() -> None:
    answer = answer_of(explained(compact(11)))
    assert answer["verdict"] == "quiet", answer["why"]
    assert answer["effects"] == [] and answer["where"] == [] and answer["left"] == []
    assert len(answer["score_table"]) > 20


def test_too_small_a_declared_noise_is_not_an_effect() -> None:
    explanation = explained(compact(12, doppler_noise_factor=1.6), without=(*HEAVY, "tracker-frame-jump"))
    answer = answer_of(explanation)
    assert answer["effects"] == []
    assert answer["verdict"] == "unknown" and "noise" in answer["why"]
    assert [w["residual"] for w in answer["white_noise"]] == ["doppler"]
    # The tracker's noise, which is as declared, has its share in every beam: less than 1.6 of the whole.
    assert 1.1 < answer["white_noise"][0]["factor"] < 1.7


def test_an_effect_that_the_library_does_not_hold_stays_unknown() -> None:
    """A comb on one beam, which no candidate has; the place and the channel are told, and no name is given."""
    import casadi as ca

    stranger = EffectInstance(
        "comb", "comb", "doppler", (Parameter("size", "Hz", 1.0, (-9.0, 9.0)),),
        lambda sample, p: ca.vertcat(0, 0, p[0] * ca.sin(2 * ca.pi * sample.time / 17.0)), "size = 0", "none")
    explanation = explained(compact(13, {stranger: [3.0]}), without=(*HEAVY, "tracker-frame-jump"))
    answer = answer_of(explanation)
    assert answer["verdict"] == "unknown", answer["why"]
    assert {p["channel"] for p in answer["left"]} == {"doppler"}
    assert all(p["components"] == [2] for p in answer["left"])
    assert answer["next_measurement"]


def test_without_its_name_in_the_library_an_effect_is_unknown_not_something_else() -> None:
    """A lever arm shows in the positions inside the arcs, and through the fitted velocity in the Doppler shift."""
    explanation = explained(compact(14, {"gnss-lever-arm": [9.0, -7.0, 8.0]}),
                            without=(*HEAVY, "tracker-frame-jump", "gnss-lever-arm"))
    answer = answer_of(explanation)
    assert answer["verdict"] == "unknown", answer["why"]
    # Steps at the ends of arcs leave little but ringing beside the trajectory: structure or noise, in the positions.
    told = {p["channel"] for p in answer["left"]} | {w["residual"] for w in answer["white_noise"]}
    assert "gnss" in told and told <= {"gnss", "doppler"}
    assert answer["effects"] == []


# ---------------------------------------------------------------------------------------------------- answers


def keys_of_the_contract(answer: dict[str, Any]) -> None:
    assert answer["verdict"] in ("quiet", "named", "ambiguous", "unknown")
    assert isinstance(answer["next_measurement"], str) and answer["seconds"] > 0
    for place in answer["where"]:
        assert {"channel", "arcs", "time_scale_s", "unit", "excess"} <= set(place)
    for effect in answer["effects"]:
        assert {"name", "group", "parameters", "score", "p_value_after_search", "gap_before", "gap_after",
                "held_out_before", "held_out_after"} <= set(effect)
        assert effect["group"][0] == effect["name"]
        for parameter in effect["parameters"].values():
            assert {"value", "sigma", "unit"} <= set(parameter)


def test_answer_text_and_page_agree() -> None:
    explanation, _ = hidden(0)
    answer = answer_of(explanation)
    keys_of_the_contract(answer)
    text, page = text_of(explanation), page_of(explanation, "flight.nc")
    for effect in answer["effects"]:
        assert effect["name"] in text and effect["name"] in page
    assert len(answer["sentences"]) == 3 and all(s.endswith(".") for s in answer["sentences"])
    assert all(s in text for s in answer["sentences"])
    assert page.count("<svg") >= len(answer["effects"]) + 1
    # Nothing in the page can be fetched: every reference stays inside it.
    assert "default-src 'none'" in page and "<script" not in page
    references = re.findall(r'(?:src|href|xlink:href)\s*=\s*"([^"]*)"', page)
    assert references and all(r.startswith(("#", "data:")) for r in references)
    assert not re.findall(r"url\((?!#)", page) and "@import" not in page


def test_command_writes_json_and_report(tmp_path: Path) -> None:
    file, page = tmp_path / "flight.nc", tmp_path / "page.html"
    write_campaign(compact(41, {"gravity-gradient-torque": None}), file)
    without = ",".join((*HEAVY, "tracker-frame-jump"))
    result = CliRunner().invoke(app, [str(file), "--report", str(page), "--without", without, "--json"])
    answer = json.loads(result.stdout)
    keys_of_the_contract(answer)
    assert answer["verdict"] == "named" and result.exit_code == 0
    assert answer["estimate"]["antenna_from_tracker"]["quaternion"] is not None
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")


@pytest.mark.parametrize(("arguments", "complaint"), [
    (["--hold-out", "0.9"], "held-out fraction"),
    (["--without", "no-such-effect"], "no-such-effect"),
    (["--report", "/nowhere/at/all/page.html"], "folder"),
    (["--effects-file", "/nowhere/mine.py"], "mine.py"),
])
def test_bad_requests_are_told(tmp_path: Path, arguments: list[str], complaint: str) -> None:
    file = tmp_path / "flight.nc"
    write_campaign(compact(15), file)
    result = CliRunner().invoke(app, [str(file), "--json", *arguments])
    answer = json.loads(result.stdout)
    assert result.exit_code == 2 and answer["status"] == "bad_input" and complaint in answer["why"]


# ---------------------------------------------------------------------------------------------------- what next


@functools.cache
def planning() -> tuple[Any, dict[str, Any], list[next_measurement.Option]]:
    model = alignment_model(compact(16))
    values = {n: np.asarray(v) for n, v in alignment_problem(model).start.items() if n != "trajectory"}
    return model, values, next_measurement.options_of(model)


def plan(option: next_measurement.Option) -> Any:
    model, values, options = planning()
    orbit = next_measurement._Orbit(model, max(o.start + o.duration for o in options) + 300.0)
    return next_measurement.planned(model, option, values, orbit, next_measurement._usual_attitude(model))


def test_planned_rotation_keeps_energy_and_momentum() -> None:
    _, values, options = planning()
    option = next(o for o in options if o.kind == "free_rotation")
    future = plan(option)
    tracker = future.campaign.star_tracker
    attitude = Rotation.from_quat(tracker.quaternion, scalar_first=True)
    step = np.diff(tracker.time)
    rate = -(attitude[1:] * attitude[:-1].inv()).as_rotvec() / step[:, None]  # at the middles, tracker axes
    inertia = future.start.normalized_inertia
    middle = Rotation.from_rotvec(0.5 * (attitude[1:] * attitude[:-1].inv()).as_rotvec()) * attitude[:-1]
    momentum = middle.inv().apply(rate @ inertia)
    energy = np.einsum("ni,ij,nj->n", rate, inertia, rate)
    assert np.linalg.norm(rate[0]) == pytest.approx(np.linalg.norm(option.rate), rel=1e-3)
    assert np.ptp(energy) < 1e-4 * energy.mean()
    assert np.ptp(momentum, axis=0).max() < 1e-4 * np.linalg.norm(momentum[0])
    assert "normalized_inertia" in values


def test_planned_pulse_gains_the_momentum_of_its_torque() -> None:
    _, _, options = planning()
    option = next(o for o in options if o.kind == "torque_pulse" and o.axis == 1)
    future = plan(option)
    torque, tracker = future.campaign.torque, future.campaign.star_tracker
    attitude = Rotation.from_quat(tracker.quaternion, scalar_first=True)
    early = tracker.time < torque.stop[0]
    turned = -(attitude[1:] * attitude[:-1].inv()).as_rotvec() / np.diff(tracker.time)[:, None]
    rate = turned[early[1:]][-1]
    actuator = Rotation.from_quat(future.start.actuator_from_tracker, scalar_first=True)
    gained = actuator.inv().apply(torque.command[0]) * (tracker.time[1:][early[1:]][-1] - torque.start[0])
    momentum = future.start.inertia_trace * future.start.normalized_inertia @ rate
    # The last difference stands for the rate half a step earlier; the body turns little in a quarter of the pulse.
    np.testing.assert_allclose(momentum, gained, atol=0.08 * np.linalg.norm(gained))


def test_planned_data_fit_the_model_they_were_planned_with() -> None:
    _, values, options = planning()
    for option in (o for kind in ("doppler", "free_rotation", "torque_pulse") for o in options if o.kind == kind):
        future = plan(option)
        problem = alignment_problem(future)
        point = {**problem.start, **{n: v for n, v in values.items() if n in next_measurement.SHARED
                                     and n in problem.start}}
        for residual, part in zip(problem.residuals, problem.linearize(point), strict=True):
            if residual.channel != "gnss":
                # Noise-free data: what is left is the trajectory's error in Doppler, and nothing in attitude.
                assert np.sqrt(np.mean(part.whitened**2)) < 0.2, (option.words, residual.name)


def test_separation_is_what_a_refit_with_the_wrong_name_leaves() -> None:
    """Against stacked rows and a dense least-squares refit, on the campaign at hand."""
    model, values, _ = planning()
    group = ("doppler-bias", "carrier-frequency-offset")
    effects = {e.name: e for e in model.effect_instances(group)}
    sizes = {"doppler-bias": np.array([4.0]), "carrier-frequency-offset": np.array([3e-6])}
    told = next_measurement._told(model, values, effects, (), sizes)
    found = next_measurement.separation([told], group, ())
    problem = alignment_problem(model, candidates=group)
    point = {**problem.start, **values}
    problem = problem.prepared(point)
    columns: dict[str, list[np.ndarray]] = {u.name: [] for u in problem.unknowns}
    for part in problem.linearize(point):
        offset = 0
        present = {}
        for u in part.columns:
            width = u.manifold.tangent
            block = part.jacobian[:, :, offset : offset + width] * np.sqrt(part.weight)[:, None, None]
            present[u.name] = block.reshape(-1, width) * u.scales
            offset += width
        for u in problem.unknowns:
            columns[u.name].append(present.get(u.name, np.zeros((part.whitened.size, u.manifold.tangent))))
    whole = {n: np.concatenate(blocks) for n, blocks in columns.items()}
    left = []
    for truth, taken in (group, group[::-1]):
        shape = whole[truth] @ (sizes[truth] / problem.unknown(truth).scales)
        others = np.hstack([block for n, block in whole.items() if n not in group or n == taken])
        others = others / np.maximum(np.linalg.norm(others, axis=0), 1e-12)
        left.append(np.linalg.norm(shape - others @ np.linalg.lstsq(others, shape, rcond=1e-13)[0]))
    assert found == pytest.approx(min(left), rel=1e-3)


def test_advice_gains_separation_with_every_arc() -> None:
    model, values, _ = planning()
    group = ("doppler-bias", "carrier-frequency-offset")
    fits = {"doppler-bias": {**values, "doppler-bias": np.array([2.0])},
            "carrier-frequency-offset": {**values, "carrier-frequency-offset": np.array([1.5e-6])}}
    advice = next_measurement.advise(model, group, (), fits)
    assert advice is not None
    assert all(p.separation >= advice.now * (1 - 1e-6) for p in advice.prospects)
    assert advice.best.option.kind == "doppler"
    assert advice.best.separation > advice.now
    assert advice.best.option.words in advice.sentence
    # A turn of the body shows nothing of the radar.
    turns = [p.separation for p in advice.prospects if p.option.kind != "doppler"]
    np.testing.assert_allclose(turns, advice.now, rtol=1e-3)
