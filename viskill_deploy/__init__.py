"""ViSkill policies on the da Vinci Research Kit, safely."""
