"""The documentation page of the effects, written from their declarations.

``python -m estimator.effects.documentation`` writes ``docs/effects.md`` for the effects shipped here, and with
``--effects-file`` also for those of a user's files.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from estimator.effects.declaration import Effect, EffectInstance, Layout, Parameter
from estimator.effects.library import load, shipped
from estimator.models.files import written_atomically

CHANNELS = {
    "torque": "Torque on the body (N m, tracker axes)",
    "command": "Commanded torque (N m, actuator axes)",
    "star_tracker": "Star tracker (rotation vector, rad, tracker axes)",
    "doppler": "Doppler shift (Hz, each beam)",
    "gnss": "Satellite navigation position (m, Earth-fixed axes)",
}

EXAMPLE = Layout(beams=3, sessions=((300.0, 360.0), (1900.0, 1960.0)), span=(0.0, 21600.0), orbital_period=5900.0,
                 tracker_span=(300.0, 21200.0),
                 beam_directions=((0.0, 0.309, 0.951), (-0.268, -0.155, 0.951), (0.268, -0.155, 0.951)))
"""The campaign for which the page shows the parameters: three beams about the antenna's +z, two Doppler sessions."""


def _number(value: float) -> str:
    return f"{value:g}"


def _row(parameter: Parameter) -> str:
    notes = []
    if parameter.nominal is not None:
        notes.append(f"physics demands {_number(parameter.nominal)}")
    if parameter.search is not None:
        low, high, count, spacing = parameter.search[:4]
        notes.append(f"searched first: {count} values from {_number(low)} to {_number(high)}, {spacing}")
    low, high = parameter.plausible
    cells = (f"`{parameter.name}`", parameter.unit, _number(parameter.scale), f"{_number(low)} to {_number(high)}",
             "; ".join(notes))
    return f"| {' | '.join(cells)} |"


def _section(effect: Effect, instances: tuple[EffectInstance, ...]) -> list[str]:
    lines = [f"### `{effect.name}`", "", effect.summary, ""]
    if effect.formula:
        lines += [f"- Contribution: `{effect.formula}`"]
    if not instances:
        return [*lines, "- It does not exist on the example campaign.", ""]
    first = instances[0]
    if len(instances) > 1 or first.name != effect.name:
        lines += ["- Instances on the example campaign: " + ", ".join(f"`{i.name}`" for i in instances)]
    lines += [f"- Zero: {first.zero}"]
    if first.state_size:
        lines += [f"- Internal states: {first.state_size}, zero at the start of each rotation arc"]
    lines += [f"- Reference: {first.reference}", "",
              "| parameter | unit | typical | plausible | |", "|---|---|---|---|---|",
              *(_row(p) for p in first.parameters), ""]
    return lines


def render(effects: Mapping[str, Effect], layout: Layout = EXAMPLE) -> str:
    """The page as Markdown text.

    Args:
        effects: by name.
        layout: of the campaign for which instances and parameters are listed.
    """
    lines = [
        "# Effects that a campaign's model may be missing", "",
        "Written by `python -m estimator.effects.documentation` from the declarations; do not edit. "
        "[How to write an effect](write_an_effect.md).", "",
        "With all ordinary parameters zero an effect contributes nothing. A searched parameter (a time, a frequency) "
        "has no zero. The plausible range is what an engineer would believe; an estimate counts as outside it only "
        "beyond its own uncertainty. The parameters are shown for a campaign of "
        f"{layout.beams} beams and {len(layout.sessions)} Doppler sessions.", "",
        "| effect | channel | parameters |", "|---|---|---|",
    ]
    found = {name: effect.instances(layout) for name, effect in effects.items()}
    for name, effect in effects.items():
        count = len(found[name][0].parameters) if found[name] else 0
        lines.append(f"| [`{name}`](#{name}) | {effect.channel} | {count} |")
    lines.append("")
    for channel, title in CHANNELS.items():
        chosen = [e for e in effects.values() if e.channel == channel]
        if chosen:
            lines += [f"## {title}", ""]
            for effect in chosen:
                lines += _section(effect, found[effect.name])
    return "\n".join(lines).rstrip() + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Write the page; the exit status is 0."""
    parser = argparse.ArgumentParser(description="Write the documentation page of the effects.")
    parser.add_argument("--output", type=Path, default=Path("docs/effects.md"))
    parser.add_argument("--effects-file", action="append", default=[], help="also a file or directory of effects")
    chosen = parser.parse_args(arguments)
    effects = shipped()
    if chosen.effects_file:
        effects = load(chosen.effects_file)
    text = render(effects)
    chosen.output.parent.mkdir(parents=True, exist_ok=True)
    with written_atomically(chosen.output) as partial:
        partial.write_text(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
