"""Skills that operate a panel: one file per kind of control, with typed outcomes; only a read-back makes one `done`.

The names below are what a package needs that adds a skill of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from manipulation.skills.attempt import Attempt
    from manipulation.skills.context import SkillContext
    from manipulation.skills.outcome import ObjectState, SkillReport, Verify
    from manipulation.skills.repeat import perform
    from manipulation.skills.toggle import throw

__all__ = ["Attempt", "ObjectState", "SkillContext", "SkillReport", "Verify", "perform", "throw"]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
