"""The data plane: what runs inside a node. Never imports ``orchestrator``."""

from shared_store import keep_old_names

OLD_NAMES = {
    "worker.deploy.model": "worker.deploy.model_file",
    "worker.learning.ppo.settings": "worker.settings.ppo",
    "worker.learning.rsl.settings": "worker.settings.rsl_rl",
    "worker.learning.sac.settings": "worker.settings.sac",
    "worker.race": "racer.race.__main__",
    "worker.racer": "racer.tracks",
    "worker.racer.car_arrays": "racer.car.car_arrays",
    "worker.racer.rewards": "racer.rewards",
    "worker.racer.rewards.kept": "racer.rewards.reward_file",
    "worker.tasks.config": "worker.settings.task",
    "worker.tasks.configs": "worker.settings",
    "worker.tasks.configs.racer": "racer.settings.task",
    "worker.tasks.gym": "worker.tasks.run.gym",
    "worker.tasks.interface": "worker.tasks.declare.interface",
    "worker.tasks.lift": "worker.tasks.library.lift",
    "worker.tasks.overrides": "worker.settings.overrides",
    "worker.tasks.racer": "racer.car.task",
    "worker.tasks.rsl_rl_env": "worker.learning.rsl.vector_environment",
    "worker.tasks.task": "worker.tasks.run.task",
    "worker.tasks.terms.following": "worker.tasks.terms.more.following",
    "worker.tasks.terms.frame_sampling": "worker.tasks.terms.more.frame_sampling",
    "worker.tasks.terms.motion": "worker.tasks.terms.more.motion",
    "worker.tasks.terms.tracking": "worker.tasks.terms.more.tracking",
}
"""Names in the documentation before the modules moved into rooms."""
keep_old_names(OLD_NAMES)
