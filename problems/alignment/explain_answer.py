"""The findings of the discrepancy workflow on a campaign, as the machine-readable answer and as words.

:func:`answer_of` gives the JSON contract of ``boresight explain``; :func:`three_sentences` and :func:`text_of` say the
same to a person: where the gap is, what it is, and what data that no fit used say about it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from estimator.discrepancy.dependence import Dependence
from estimator.discrepancy.empirical import EmpiricalTerm
from estimator.discrepancy.gap import Gap, Place
from estimator.discrepancy.proof import HeldOut
from estimator.discrepancy.score import Score
from estimator.discrepancy.search import Finding, Findings, Workflow
from estimator.effect_uncertainty import sigma_of
from estimator.effects.declaration import EffectInstance
from estimator.estimate import Estimate

if TYPE_CHECKING:
    from problems.alignment.investigation import AlignmentSubject
    from problems.alignment.next_measurement import Advice

ARCSECONDS = 180 / np.pi * 3600  # arcsec in a radian
_CHANNEL_WORDS = {"star_tracker": "star tracker", "gnss": "positions", "doppler": "Doppler"}


@dataclass(frozen=True, eq=False)
class Explanation:
    """A campaign's findings with what made them, for answers and reports.

    Attributes:
        subject: the campaign under investigation.
        workflow: the finished search; its fits are kept.
        findings: what it found.
        advice: the measurement that would separate an ambiguous group; None where nothing is ambiguous or nothing
            that can be asked for helps.
        seconds: wall time of everything.
        depends_on: covariates that the disagreement with the plain model goes with.
        left_depends_on: covariates that what is left goes with.
        empirical: terms that carry the shape of what is left where the verdict is "unknown".
    """

    subject: AlignmentSubject
    workflow: Workflow
    findings: Findings
    advice: Advice | None
    seconds: float
    depends_on: tuple[Dependence, ...] = ()
    left_depends_on: tuple[Dependence, ...] = ()
    empirical: tuple[EmpiricalTerm, ...] = ()

    @property
    def accepted(self) -> tuple[str, ...]:
        """Names of the effects, in the order in which they were added."""
        return tuple(f.name for f in self.findings.findings)

    def instance(self, name: str) -> EffectInstance:
        """The declaration of an effect on this campaign.

        Raises:
            KeyError: the library does not hold it.
        """
        return self.workflow.library[name]


def readable(value: float, unit: str) -> tuple[float, str]:
    """An angle in seconds of arc, anything else as it is."""
    return (value * ARCSECONDS, "arcsec") if unit == "rad" else (value, unit)


def channels_of(estimate: Estimate, name: str) -> tuple[str, ...]:
    """Channels whose residuals the effect changes; all of them where the fit does not see the effect."""
    touched = [r.channel for r in estimate.problem.residuals if any(u.name == name for u in r.unknowns)]
    return tuple(dict.fromkeys(touched or [r.channel for r in estimate.problem.residuals]))


def gap_number(misfits: Mapping[str, HeldOut], channels: Sequence[str]) -> float | None:
    """Root mean square miss over the noise of these channels together: 1 where nothing but noise is left."""
    chosen = [misfits[c] for c in channels if c in misfits and misfits[c].count]
    if not chosen:
        return None
    return float(np.sqrt(sum(h.square for h in chosen) / sum(h.count for h in chosen)))


def physical(before: Mapping[str, HeldOut], after: Mapping[str, HeldOut], channels: Sequence[str]) -> dict[str, Any]:
    """Miss before and after beside the noise floor, per channel: Hz, arcsec, m."""
    result: dict[str, Any] = {}
    for channel in channels:
        if channel not in before or channel not in after:
            continue
        first, second = before[channel], after[channel]
        value, unit = readable(first.rms, first.unit)
        result[channel] = {"before": value, "after": readable(second.rms, second.unit)[0],
                           "floor": readable(second.floor, second.unit)[0], "unit": unit,
                           "ratio_before": first.ratio, "ratio_after": second.ratio, "count": second.count}
    return result


def parameters_of(estimate: Estimate, effect: EffectInstance) -> dict[str, dict[str, Any]]:
    """Value, sigma and unit of each parameter of an effect; the sigma is None where the data do not determine it."""
    if all(u.name != effect.name for u in estimate.unknowns):
        return {}
    values, sigma = estimate.values[effect.name], sigma_of(estimate, effect)
    return {p.name: {"value": float(v), "sigma": float(s) if np.isfinite(s) else None, "unit": p.unit}
            for p, v, s in zip(effect.parameters, values, sigma, strict=True)}


def place_sentence(place: Place, depends_on: Sequence[Dependence]) -> str:
    """Where it is, and what it goes with."""
    mine = [d for d in depends_on if d.channel == place.channel]
    return "; ".join([place.sentence, *(goes_with(d, place) for d in mine)])


def goes_with(dependence: Dependence, place: Place) -> str:
    """The relation in words, without the components where they are those of the place."""
    if dependence.components != place.components:
        return dependence.sentence
    return dependence.sentence.split(": ", 1)[1]


def _places(gap: Gap, depends_on: Sequence[Dependence]) -> list[dict[str, Any]]:
    result = []
    for p in gap.places:
        value, unit = readable(p.excess, p.unit)
        result.append({"channel": p.channel, "arcs": list(p.arcs), "time_scale_s": p.time_scale, "unit": unit,
                       "excess": value, "floor": readable(p.floor, p.unit)[0], "components": list(p.components),
                       "p_value": p.p_value, "sentence": place_sentence(p, depends_on),
                       "depends_on": [_dependence(d) for d in depends_on if d.channel == p.channel]})
    return result


def _dependence(d: Dependence) -> dict[str, Any]:
    excess, unit = readable(d.excess, d.unit)
    slope = None if d.slope is None else readable(d.slope, d.unit)[0]
    simple = d.covariate_unit.isalnum()
    per = "" if d.covariate_unit == "1" else f"/{d.covariate_unit}" if simple else f"/({d.covariate_unit})"
    return {"covariate": d.covariate, "components": list(d.components), "form": d.form, "p_value": d.p_value,
            "share": d.share, "excess": excess, "floor": readable(d.floor, d.unit)[0], "unit": unit, "slope": slope,
            "slope_unit": None if slope is None else unit + per, "alike": list(d.alike), "sentence": d.sentence}


def empirical_entry(term: EmpiricalTerm) -> dict[str, Any]:
    """One empirical term as JSON; angles in seconds of arc."""

    def shown(value: float | None) -> float | None:
        return None if value is None or not np.isfinite(value) else readable(value, term.unit)[0]

    unit = readable(1.0, term.unit)[1]
    return {
        "label": "EMPIRICAL", "channel": term.channel, "component": term.component, "arcs": list(term.arcs),
        "form": term.form, "period_s": term.period, "unit": unit, "amplitude": shown(term.amplitude),
        "sigma": shown(term.sigma), "rms": shown(term.rms), "log_odds": term.worth, "floor": shown(term.floor),
        "fitted_before": shown(term.fitted_before), "fitted_after": shown(term.fitted_after),
        "held_out_before": shown(term.held_out_before), "held_out_after": shown(term.held_out_after),
        "refused": list(term.refused), "sentence": term.sentence,
        "parameters": [{"name": p.name, "value": shown(p.value), "sigma": shown(p.sigma), "unit": unit}
                       for p in term.parameters],
    }


def _line(score: Score, effect: EffectInstance) -> dict[str, Any]:
    return {
        "name": score.name, "score": score.score, "degrees": score.degrees, "p_value": score.p_value,
        "evidence": score.evidence, "power": score.power, "visible": score.visible,
        "absorbed_by": list(score.absorbed_by),
        "expected": {p.name: {"value": float(v), "sigma": float(s) if np.isfinite(s) else None, "unit": p.unit}
                     for p, v, s in zip(effect.parameters, score.size, score.sigma, strict=True)},
    }


def _finding(explanation: Explanation, finding: Finding) -> dict[str, Any]:
    effect = explanation.instance(finding.name)
    channels = channels_of(explanation.findings.final, finding.name)
    return {
        "name": finding.name,
        "group": list(finding.group),
        "parameters": parameters_of(explanation.findings.final, effect),
        "score": finding.score,
        "degrees": finding.degrees,
        "p_value_after_search": finding.p_value_after_search,
        "gap_before": gap_number(finding.gap_before, channels),
        "gap_after": gap_number(finding.gap_after, channels),
        "held_out_before": gap_number(finding.held_out_before, channels),
        "held_out_after": gap_number(finding.held_out_after, channels),
        "gap": physical(finding.gap_before, finding.gap_after, channels),
        "held_out": physical(finding.held_out_before, finding.held_out_after, channels),
        "expected": _line(finding.expected, effect)["expected"],
        "moved_sigma": dict(finding.moved),
        "reference": effect.reference,
    }


def answer_of(explanation: Explanation) -> dict[str, Any]:
    """The machine-readable answer of ``boresight explain``.

    ``gap_*`` and ``held_out_*`` numbers are the root mean square miss over the noise floor in the channels that the
    effect changes (1 is the floor), of the data in the fit and of the data kept from it; ``gap`` and ``held_out`` give
    the same per channel in Hz, arcsec and m.
    """
    findings = explanation.findings
    library = explanation.workflow.library
    answer: dict[str, Any] = {
        "verdict": findings.verdict,
        "why": findings.why,
        "where": _places(findings.before, explanation.depends_on),
        "effects": [_finding(explanation, f) for f in findings.findings],
        "next_measurement": next_measurement_sentence(explanation),
        "next_measurement_options": [] if explanation.advice is None else explanation.advice.as_list(),
        "sentences": list(three_sentences(explanation)),
        "left": _places(findings.after, explanation.left_depends_on),
        "white_noise": [{"residual": name, "factor": factor} for name, factor in findings.after.white],
        "rejected": list(findings.rejected),
        "looks": findings.looks,
        "score_table": [_line(s, library[s.name]) for s in (findings.tables[0] if findings.tables else ())],
        "estimate": _estimate(explanation),
        "hold_out": explanation.subject.hold_out,
        "seconds": explanation.seconds,
    }
    if findings.verdict == "unknown":
        answer["empirical"] = [empirical_entry(t) for t in explanation.empirical]
    return answer


def _estimate(explanation: Explanation) -> dict[str, Any]:
    """The joint estimate of all data with the effects that were found, as ``boresight solve`` gives it."""
    from problems.alignment.screening import screen
    from problems.alignment.solution import concluded

    subject = explanation.subject
    solution = concluded(subject.everything, explanation.findings.final, screen(subject.campaign),
                         explanation.findings.final.seconds)
    whole = solution.as_dict()
    kept = ("status", "why", "chi2_per_dof", "antenna_from_tracker", "actuator_from_tracker", "normalized_inertia",
            "inertia_trace", "trajectory", "unobservable", "residuals")
    return {key: whole[key] for key in kept if key in whole}


# ---------------------------------------------------------------------------------------------------- sentences


def number(value: float, sigma: float | None, unit: str) -> str:
    """A value with its sigma, angles in seconds of arc."""
    factor = 1.0
    if unit == "rad":
        factor, unit = ARCSECONDS, "arcsec"
    shown = "" if unit == "1" else f" {unit}"
    if sigma is None or not np.isfinite(sigma):
        return f"{factor * value:.4g}{shown} (not determined)"
    decimals = int(np.clip(1 - np.floor(np.log10(max(factor * sigma, 1e-12))), 0, 12))
    if factor * sigma < 1e-4:
        return f"{factor * value:.4g} +- {factor * sigma:.2g}{shown}"
    return f"{factor * value:.{decimals}f} +- {factor * sigma:.{decimals}f}{shown}"


def _sizes(explanation: Explanation, name: str) -> str:
    parameters = parameters_of(explanation.findings.final, explanation.instance(name))
    shown = [f"{key} {number(p['value'], p['sigma'], p['unit'])}" for key, p in parameters.items()]
    if len(shown) > 8:
        shown = [*shown[:3], f"and {len(shown) - 3} more"]
    return ", ".join(shown)


def _listed(names: Sequence[str], word: str = "and") -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + f" {word} " + names[-1]


def three_sentences(explanation: Explanation) -> tuple[str, str, str]:
    """Where, what, and the proof."""
    return _where(explanation), _what(explanation), _proof(explanation)


def _where(explanation: Explanation) -> str:
    before = explanation.findings.before
    if before.present:
        return "The plain model and the data disagree in " + "; ".join(
            place_sentence(p, explanation.depends_on) for p in before.places) + "."
    if before.white:
        noise = _listed([f"{name.replace('_', ' ')} by a factor {factor:.2f}" for name, factor in before.white])
        return f"The residuals show no structure, but white noise above the declared one: {noise}."
    if explanation.findings.findings:
        return ("No single place shows the disagreement by itself; it shows only where all data are tested together "
                "for the signature of an effect.")
    return "The plain model and the data agree everywhere within the declared noise."


def _what(explanation: Explanation) -> str:
    findings = explanation.findings
    if not findings.findings:
        if findings.verdict == "quiet":
            return (f"None of the {len(explanation.workflow.library)} effects of the library is significant "
                    f"(a search that amounts to {findings.looks:.0f} independent names).")
        return "No effect of the library explains it."
    parts = []
    for f in findings.findings:
        phrase = f"{f.name} ({_sizes(explanation, f.name)})"
        if len(f.group) > 1:
            phrase += ", which these data cannot tell from " + _listed(f.group[1:], "or")
        parts.append(phrase)
    sentence = f"Missing {'was' if len(parts) == 1 else 'were'} " + "; and ".join(parts)
    if findings.after.present:
        sentence += "; something that the library does not hold is left"
    return sentence + "."


def _proof(explanation: Explanation) -> str:
    findings = explanation.findings
    if not findings.findings:
        if findings.after.present:
            return "Unexplained remains all of it" + _carried(explanation) + "."
        if findings.verdict == "unknown":
            return "Declare the larger noise and ask again."
        return "Nothing was added, so there is nothing to prove."
    first, last = findings.findings[0].held_out_before, findings.findings[-1].held_out_after
    touched = [c for c in last if any(c in channels_of(findings.final, f.name) for f in findings.findings)]
    shown = [f"{_CHANNEL_WORDS.get(c, c)} from {v['before']:.3g} to {v['after']:.3g} {v['unit']} over a floor of "
             f"{v['floor']:.3g} {v['unit']}" for c, v in physical(first, last, touched).items()]
    moved = {name: shift for f in findings.findings for name, shift in f.moved.items() if shift > 1.0}
    sentence = "On data that no fit used the miss fell in " + _listed(shown) if shown else \
        "No data were held out, so nothing is proved"
    if moved:
        largest = sorted(moved.items(), key=lambda item: -item[1])[:3]
        sentence += "; the fit without it had moved " + _listed([f"{n} by {s:.1f} sigma" for n, s in largest])
    if findings.after.present:
        sentence += "; still unexplained is " + _left(explanation) + _carried(explanation)
    return sentence + "."


def _carried(explanation: Explanation) -> str:
    terms = explanation.empirical
    if not terms:
        return ""
    rest = f", and {len(terms) - 2} more" if len(terms) > 2 else ""
    return "; its shape, " + "; ".join(t.sentence for t in terms[:2]) + rest


def _left(explanation: Explanation) -> str:
    return "; ".join(place_sentence(p, explanation.left_depends_on) for p in explanation.findings.after.places)


def next_measurement_sentence(explanation: Explanation) -> str:
    """What to measure next, one sentence."""
    findings = explanation.findings
    if explanation.advice is not None:
        return explanation.advice.sentence
    if findings.verdict == "ambiguous":
        return "no free rotation, torque pulse or Doppler pass that could be asked for separates the group"
    if findings.after.present:
        place = findings.after.places[0]
        everywhere = len(place.arcs) > 4 or place.arcs[0].startswith("all ")
        arcs = "every arc" if everywhere else "arcs " + ", ".join(place.arcs)
        mine = [d for d in explanation.left_depends_on if d.channel == place.channel]
        if mine:
            beside = f", {_listed(mine[0].alike)} as they are now" if mine[0].alike else ""
            return (f"repeat {arcs} ({place.channel.replace('_', ' ')}) at other values of {mine[0].covariate}{beside}"
                    ": whether the miss follows says whether the relation is one of cause")
        return (f"repeat {arcs} ({place.channel.replace('_', ' ')}) at another time of day and with another attitude: "
                "whether the shape returns with the clock, the orbit or the attitude says what kind of effect it is")
    if findings.verdict == "unknown":
        return "a measurement of the noise itself, a still stretch of the noisy channel, to declare it as it is"
    return "none is needed: the data leave no question open that was asked"


def text_of(explanation: Explanation) -> str:
    """The answer for a terminal: verdict, three sentences, tables."""
    findings = explanation.findings
    lines = [f"{findings.verdict}: {findings.why}", "", *three_sentences(explanation)]
    if findings.findings:
        lines += ["", f"{'effect':<34}{'score':>10}{'p after search':>16}{'gap':>16}{'held out':>16}"]
        for f in findings.findings:
            entry = _finding(explanation, f)
            lines.append(f"{f.name:<34}{f.score:>10.1f}{f.p_value_after_search:>16.1e}"
                         f"{_arrow(entry['gap_before'], entry['gap_after']):>16}"
                         f"{_arrow(entry['held_out_before'], entry['held_out_after']):>16}")
        lines += ["(gap: root mean square miss over the noise floor in the channels that the effect changes)"]
        lines += ["", f"{'parameter':<50}{'value':>16}{'sigma':>14}  unit"]
        for f in findings.findings:
            for name, p in parameters_of(findings.final, explanation.instance(f.name)).items():
                sigma = "-" if p["sigma"] is None else f"{p['sigma']:.3g}"
                lines.append(f"{f.name + ' ' + name:<50}{p['value']:>16.6g}{sigma:>14}  {p['unit']}")
    if explanation.empirical:
        lines += ["", "the shape of what is left", *(f"  {t.sentence}" for t in explanation.empirical)]
    elif findings.after.present:
        lines += ["", "the shape of what is left: no simple empirical term (constants, curves or periods) is worth its "
                      "parameters"]
    if findings.tables and findings.tables[0]:
        lines += ["", "scores at the plain model", f"{'effect':<34}{'score':>10}{'degrees':>9}{'p':>10}{'power':>8}"]
        for s in findings.tables[0][:8]:
            lines.append(f"{s.name:<34}{s.score:>10.1f}{s.degrees:>9d}{s.p_value:>10.1e}{s.power:>8.2f}")
        hidden = [f"{s.name} (absorbed by {', '.join(s.absorbed_by)})" for s in findings.tables[0] if s.degrees == 0]
        if hidden:
            lines += ["not visible in these data: " + "; ".join(hidden)]
    lines += ["", f"next measurement: {next_measurement_sentence(explanation)}", f"{explanation.seconds:.1f} s"]
    return "\n".join(lines)


def _arrow(before: float | None, after: float | None) -> str:
    return "-" if before is None or after is None else f"{before:.2f} -> {after:.3f}"
