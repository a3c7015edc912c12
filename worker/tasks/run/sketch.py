"""The sketch of a task, without worlds: its robots and objects, its terms bound to them, and the names that follow."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import newton
import warp as wp

from worker.settings.task import TaskConfig
from worker.simulation.randomization_targets import check_patterns
from worker.simulation.robot_elements import empty_builder
from worker.simulation.robot_reading import Reading
from worker.simulation.robot_view import RobotView
from worker.simulation.terrain import Terrain
from worker.tasks.compile.compiler import further
from worker.tasks.compile.configured import configured
from worker.tasks.compile.declaration_checks import placed
from worker.tasks.compile.plan import KernelPlan, stacked
from worker.tasks.declare.declaration import Choice, Declaration
from worker.tasks.run.task_report import TaskReport
from worker.tasks.run.variants import changed, changed_settings, check_parts


class TaskSketch(TaskReport):
    """The part of :class:`worker.tasks.run.task.Task` that needs no worlds; a task overrides its methods up to :meth:`build`.

    Attributes:
        config: The configuration, with the weights of all rewards.
        views: Joints, bodies, sites and geoms of each robot and object, by its name.
        readings: How the file of each robot was read, by its name.
        declaration: The result of :meth:`declare`, with what :meth:`with_` and the configuration change.
        plan: The declaration, bound to the robots.
        reward_terms: Names of the rewards, in order.
        observation_names: Name of each column of the policy's group, or of the critic's where the policy sees an image.
        further_names: Name of each column of the further observation groups, such as ``critic.speed``.
        action_names: Name of each action, in order; of a discrete one, of each choice.
        action_size: How many they are.
        discrete: Whether an action is one of several choices: its number, from 0.
        metric_names: Names of the metrics, which are logged besides the rewards as means over the steps.
        termination_names: Names of the terminations, which are counted; the last is the clock.
        success: The metric or termination that makes an evaluated episode a success; None: an episode that only the clock ended is one.
        statistic_names: Of the running totals.
    """

    config: TaskConfig
    template: newton.ModelBuilder  # of a sketch
    config_type: ClassVar[type[TaskConfig]] = TaskConfig
    """Type of the configuration."""
    ground: ClassVar[bool] = False
    """Whether the worlds stand on a ground plane."""
    solver_options: Mapping[str, Any] = {}
    """Options of ``newton.solvers.SolverMuJoCo``."""
    changes: ClassVar[tuple[Mapping[str, Any], ...]] = ()
    """Changes of the declaration by :meth:`with_`."""

    def __init_subclass__(cls, *, config: Mapping[str, Any] | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        if any(isinstance(each, wp.Kernel) for each in (vars(cls).get("act"), vars(cls).get("observe"))):
            raise ValueError(
                f"task {cls.__name__}: it is two kernels, act and observe, and a task is made of terms by now; declare() gives them "
                "(docs/own-task.md)"
            )
        if config:
            cls.config_type = changed_settings(cls, config, {})

    @classmethod
    def with_(cls, *, config: Mapping[str, Any] | None = None, **parts: Any) -> type[Self]:
        """The same task with other parts: ``G1Flat.with_(rewards={"feet_flat": Reward(feet_flat, weight=-0.5)})``.

        A job names it as ``module:NAME``, as any other task.

        Args:
            config: New defaults of the configuration, by field.
            **parts: Terms by section of the :class:`Declaration` and by name; None removes one. ``observations`` are by group.
                ``actions`` may be a :class:`Choice`, ``success`` is a name.

        Raises:
            ValueError: A section does not exist, or a part is not what its section takes.
        """
        check_parts(cls, parts)
        settings = changed_settings(cls, config or {}, parts.get("rewards") or {})
        about = f"{cls.__name__} with other {', '.join((*parts, *(config or ())))}."
        members = {"__doc__": about, "config_type": settings, "changes": (*cls.changes, parts)}
        members["__module__"] = sys._getframe(1).f_globals.get("__name__", cls.__module__)
        metaclass: Any = type(cls)
        changed_task: type[Self] = metaclass(cls.__name__, (cls,), members)
        return changed_task

    @classmethod
    def sketch(cls, config: TaskConfig) -> Self:
        """The task without worlds: names, :attr:`plan`, one world (``template``). Raises ValueError for a wrong one."""
        task = cls.__new__(cls)
        task.config = config
        task.template = task._template()
        return task

    def _template(self) -> newton.ModelBuilder:
        template = empty_builder()
        self.build(template)
        return template

    def robot(self, config: Any) -> Any:
        """The robot: a :class:`worker.simulation.robot.Robot`."""
        raise NotImplementedError

    def objects(self, config: Any) -> Mapping[str, Any]:
        """Further objects in each world, by name: robots, boxes, spheres, capsules."""
        return {}

    def terrain(self, config: Any) -> Any:
        """The ground, a :class:`worker.simulation.terrain.Terrain`; None: a plane if ``ground`` is true."""
        return None

    def declare(self, config: Any) -> Declaration:
        """The terms. :attr:`views` already has the robots."""
        raise NotImplementedError

    def build(self, builder: newton.ModelBuilder) -> None:
        """Add one world to an empty builder, robots and objects, and bind the terms to them."""
        config: Any = self.config
        entities = {"robot": self.robot(config), **self.objects(config)}
        self.readings: dict[str, Reading] = {}
        for name, entity in entities.items():
            self._add(name, entity, builder)
        self.views = {name: RobotView(builder, name) for name in entities}
        declaration = self.declare(config)
        if not isinstance(declaration, Declaration):
            found = type(declaration).__name__
            raise ValueError(f"task {type(self).__name__}: declare() returned {found}, not a Declaration")
        self.ground_terrain = self.terrain(config)
        with placed(f"task {type(self).__name__}"):
            for parts in self.changes:
                declaration = changed(declaration, parts)
        self.declaration = configured(declaration, config, self.views)
        sensors = self.declaration.sensors
        for name, sensor in sensors.items():
            if hasattr(sensor, "rows"):  # a task's own sensor may have no columns
                with placed(f"task {type(self).__name__}: sensors.{name}"):
                    sensor.rows(self.views)
        try:
            self.plan = KernelPlan(self.declaration, config, self.views, sensors, self.ground_terrain is not None)
            check_patterns(self.declaration.randomize, self.views)
            if isinstance(self.ground_terrain, Terrain):
                self.ground_terrain.check_memory()
        except ValueError as error:
            # an error in a job's setting names its place in the job alone
            where = "" if str(error).startswith("config.") else f"task {type(self).__name__}: "
            raise ValueError(f"{where}{error}") from error
        self._name()
        if self.plan.weights != config.rewards:  # some stand beside their terms
            self.config = dataclasses.replace(config, rewards=self.plan.weights)

    def stands_on(self) -> bool | Terrain:
        """The result of :meth:`terrain`, or whether there is a plane."""
        return self.ground_terrain or self.ground

    def _add(self, name: str, entity: Any, builder: newton.ModelBuilder) -> None:
        where = f"task {type(self).__name__}: {'' if name == 'robot' else 'objects: '}"
        if not dataclasses.is_dataclass(entity) or isinstance(entity, type) or not hasattr(entity, "add_to"):
            found = "robot() returned" if name == "robot" else f"{name} is"
            raise ValueError(f"{where}{found} {type(entity).__name__}, which can't be put into a world")
        with placed(where.removesuffix(": ")):
            reading = dataclasses.replace(entity, name=name).add_to(builder)
        if isinstance(reading, Reading):
            self.readings[name] = reading

    def _name(self) -> None:
        """Take names from the terms."""
        plan = self.plan
        self.reward_terms, self.observation_names, self.action_names = tuple(plan.weights), plan.names, plan.actions
        self.action_size = len(self.action_names)
        groups = {group: plan.groups[group] for group in further(plan)}
        self.further_names = tuple(
            f"{group}.{name}" for group, terms in groups.items() for seen in terms for name in stacked(seen)
        )
        self.discrete = isinstance(self.declaration.actions, Choice)
        metrics = {f"metric_{name}": term for name, term in self.declaration.metrics.items()}
        self.metric_names = tuple(metrics)
        self.final_metrics = tuple(name for name, term in metrics.items() if term.at_end)
        self.shown_metrics = {name: term.shown for name, term in metrics.items() if term.shown is not None}
        self.success = self.declaration.success
        self.termination_names = tuple(f"termination_{name}" for name in (*self.declaration.terminations, "time_out"))
        self.statistic_names: tuple[str, ...] = (
            *("episodes", "episode_return", "episode_length"),
            *(*(f"reward_{name}" for name in self.reward_terms), *self.metric_names),
            *("nan_worlds", "solver_overflows", "squared_return"),
            *self.termination_names,
        )

    def notes(self) -> Sequence[str]:
        """What a user should know of its robots, one sentence each."""
        found = {name: (*each.lines(), *self.views[name].beyond_limits()) for name, each in self.readings.items()}
        return [f"{name}: {line}" for name, lines in found.items() for line in lines]
