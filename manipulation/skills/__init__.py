"""What the hand can do to a panel: one file per kind of control, with typed outcomes; nothing is done without a second look.

These names are what a package needs that brings a skill of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from manipulation.skills.attempt import Attempt
    from manipulation.skills.context import SkillContext
    from manipulation.skills.outcome import ObjectState, SkillReport, Verify
    from manipulation.skills.perform import perform
    from manipulation.skills.toggle import throw

__all__ = ["Attempt", "ObjectState", "SkillContext", "SkillReport", "Verify", "perform", "throw"]
__getattr__ = load_on_first_use(__name__, __file__)
