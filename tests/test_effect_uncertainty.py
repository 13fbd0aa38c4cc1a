"""How far the time of a jump is known: to the samples between which it lies, or to the gap in the data."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.discrepancy.search import Workflow
from estimator.effect_uncertainty import sigma_of
from problems.alignment.investigation import AlignmentSubject
from problems.alignment.simulator import preset, simulate

NAME = "tracker-frame-jump"
JUMP = (4e-4, -2e-4, 3e-4)  # rad


@pytest.mark.parametrize(("arc", "share"), [("free-2", 0.37), ("doppler-3", 0.6), ("doppler-4", 1.8)])
def test_a_jump_is_named_wherever_it_happens_and_its_time_lies_within_its_sigma(arc: str, share: float) -> None:
    """Inside an arc of rotation, inside a Doppler session, and (share above one) between two stretches of data."""
    plain, _ = simulate(preset("compact"), 901)
    place = next(a for a in plain.arcs if a.name == arc)
    truth = np.array([*JUMP, place.start + share * (place.stop - place.start)])
    campaign, _ = simulate(preset("compact"), 901, {NAME: truth.tolist()})
    workflow = Workflow(AlignmentSubject(campaign, 0.2))
    found = workflow.run()
    assert [f.name for f in found.findings] == [NAME], found.why
    sigma = sigma_of(found.final, workflow.library[NAME])
    off = np.abs(found.final.values[NAME] - truth)
    assert np.all(off[:3] < 4 * sigma[:3])
    assert off[3] <= 2 * sigma[3]  # flat between the samples: as likely at the ends as in the middle
    if share < 1:
        assert sigma[3] == pytest.approx(0.25, rel=0.2)  # half of 0.5 s between star tracker samples
    else:
        following = min(a.start for a in campaign.arcs if a.start > place.stop)
        assert sigma[3] == pytest.approx(0.5 * (following - place.stop), rel=0.05)
