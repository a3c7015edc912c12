"""The data plane: what runs inside a node. Never imports ``orchestrator``."""

from shared_store import keep_old_names

OLD_NAMES = {
    "worker.learning.ppo.settings": "worker.settings.ppo",
    "worker.learning.rsl.settings": "worker.settings.rsl_rl",
    "worker.learning.sac.settings": "worker.settings.sac",
    "worker.racer.rewards.kept": "worker.racer.rewards.reward_file",
    "worker.tasks.config": "worker.settings.task",
    "worker.tasks.configs": "worker.settings",
    "worker.tasks.configs.camera": "worker.settings.camera",
    "worker.tasks.gym": "worker.tasks.run.gym",
    "worker.tasks.interface": "worker.tasks.declare.interface",
    "worker.tasks.lift": "worker.tasks.library.lift",
    "worker.tasks.overrides": "worker.settings.overrides",
    "worker.tasks.rsl_rl_env": "worker.learning.rsl.environment",
    "worker.tasks.task": "worker.tasks.run.task",
}
"""Names in the documentation before the modules moved into rooms."""
keep_old_names(OLD_NAMES)
