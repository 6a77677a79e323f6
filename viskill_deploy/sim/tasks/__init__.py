"""One file a task."""

from viskill_deploy.sim.tasks.base import SkillSpec, Task, load_task, task_names

__all__ = ["SkillSpec", "Task", "load_task", "task_names"]
