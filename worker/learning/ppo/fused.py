"""The fused PPO, captured as CUDA graphs; a gang of ranks computes the same as one rank with all worlds.

Networks are rsl-rl's. Differences from rsl-rl 5.5.1, with reasons:

- Advantage moments, observation moments, gradients, KL and losses are sums over all ranks' samples. A minibatch has equally many steps of
  every world. Their choice, and action noise, depend only on (seed, iteration, epoch, global world index), so the number of ranks changes
  nothing but rounding. There is one collective per iteration and one per minibatch, between graphs, where NCCL's watchdog sees them.
- A time-out bootstraps from the value of the observation *after* the step, before the reset; rsl-rl uses the observation before the step.
  Images are rendered only after the reset, so image tasks bootstrap from V(s_t), as rsl-rl does.
- Values and log-probabilities are computed in one pass over the finished rollout, not step by step.
- Every epoch draws new minibatches (rsl-rl draws once and repeats the same minibatches in all epochs).
- The Gaussian's objective and its gradient are one kernel (:mod:`worker.learning.ppo.heads`), and on CUDA actor and critic run side by side.
- The learning rate is a tensor and its rule runs on the device. Nothing here waits for the device.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from types import ModuleType
from typing import Any, ClassVar

import torch
from tensordict import TensorDict

from worker.learning.algorithm import POLICY, LearningSetting, Spaces, Transition
from worker.learning.cuda_graph import CudaGraphFunction
from worker.learning.observations import gather_moments, merge_moments
from worker.learning.parts import Totals, keep_gradients, load_optimizer
from worker.learning.ppo import draws, heads
from worker.learning.ppo import linear_layers as linear
from worker.learning.ppo.draws import Draws
from worker.learning.ppo.heads import LOSSES, Categorical, Gaussian
from worker.learning.ppo.networks import ActorPolicy, build_actor, build_critic
from worker.learning.ppo.rollout_buffer import GroupRollout, RolloutBuffer
from worker.settings.ppo import PPOConfig

RATE_STEP = 1.5
"""rsl-rl's adaptive rule: divide the learning rate above 2 × the desired KL, multiply it below half, within its limits."""
METRICS = (*LOSSES, "learning_rate", "action_std", "explained_variance", "clip_fraction", "gradient_norm", "saturation")
"""Names of an update's metrics; ``saturation`` only if some action has a range."""
_ADVANTAGES = ("count", "advantages", "squared_advantages")


class PPO:
    """See :class:`worker.learning.algorithm.Algorithm`."""

    config_type: ClassVar[type[PPOConfig]] = PPOConfig
    captures_rollout: ClassVar[bool] = True
    kernels: ClassVar[tuple[ModuleType, ...]] = (draws, heads)

    def __init__(self, config: PPOConfig, setting: LearningSetting) -> None:
        """Raises ValueError for unsupported settings."""
        self.config, self.setting, self.gang = config, setting, setting.gang
        self.steps, self.device = config.steps, setting.gang.device
        spaces, worlds = setting.spaces, setting.share.count
        self.actor = build_actor(config, spaces)
        self.critic = build_critic(config, spaces, self.actor).to(self.device)
        self.actor.to(self.device)
        self._policy = ActorPolicy(self.actor, spaces)
        actor = GroupRollout(self.actor, POLICY, spaces.observations[POLICY], self.steps, worlds, self.device)
        critic, group = actor, config.critic_observations
        if group != POLICY:
            critic = GroupRollout(self.critic, group, spaces.observations[group], self.steps, worlds, self.device)
        self.rollout = RolloutBuffer(actor, critic, spaces.actions, 1 if spaces.discrete else spaces.actions)
        self._draws = Draws(setting.seed, setting.share.first, self.device)
        self._side = torch.cuda.Stream(self.device) if self.device.startswith("cuda") else None
        self._allocate_sums()
        self._allocate_gradients()
        self._allocate_minibatches()
        weight = worlds / setting.share.total
        self._head = (
            Categorical(weight, config, self.device)
            if spaces.discrete
            else Gaussian(self.actor, len(self._rows), weight, config)
        )
        self.graphs = self._make_graphs()
        for parameter in self._parameters:
            self.gang.broadcast(parameter.data)

    def _allocate_sums(self) -> None:
        """Buffer summed over the ranks before the minibatches: moments of the advantages, and sums of every observation normaliser."""
        normalised = [view for view in self.rollout.views if getattr(view.model, "obs_normalization", False)]
        sizes = {view.group: 2 * view.latents.shape[-1] for view in normalised}
        self._sums = Totals({**dict.fromkeys(_ADVANTAGES, 1), **sizes}, self.device)
        self._normalised = [(view, view.model.obs_normalizer, self._sums[view.group]) for view in normalised]
        figures = ("returns", "squared_returns", "clipped", "saturated")
        self._figures = Totals(dict.fromkeys(figures, 1), self.device)
        """Summed over the ranks after the minibatches, apart from the sums before: so their bits do not depend on the metrics."""
        ranges = [each or (-math.inf, math.inf) for each in self.setting.action_ranges]
        self._ranges = torch.tensor(ranges, device=self.device).view(-1, 2).t()
        self._ranged = sum(each is not None for each in self.setting.action_ranges)
        """Number of an action's components that have a range."""

    def _allocate_gradients(self) -> None:
        """One flat buffer: all gradients, then the other shared numbers of a minibatch. The parameters' gradients are views of it.

        Each begins at a multiple of :data:`worker.learning.ppo.linear_layers.ALIGNED`, with zeros between them.
        """
        actor = list(self.actor.parameters())
        shared = set(map(id, actor))  # convolutions may be shared with the actor
        critic = [parameter for parameter in self.critic.parameters() if id(parameter) not in shared]
        sizes = [sum(linear.aligned(p.numel()) for p in part) for part in (actor, critic)]
        self._parameters = actor + critic
        self._shared = torch.zeros(sum(sizes) + len(LOSSES), device=self.device)
        keep_gradients(self._parameters, self._shared, linear.ALIGNED)
        *gradients, self._losses = self._shared.split([*sizes, len(LOSSES)])
        self._gradients = gradients
        self._rate = torch.tensor(self.config.learning_rate, device=self.device)
        self._greatest_rate = torch.tensor(self.config.greatest_rate(0), device=self.device)
        self._normalizer_learns = torch.ones((), dtype=torch.float64, device=self.device)
        options: dict[str, Any] = {"capturable": True} if self._side is not None else {}
        kind: type[torch.optim.Adam] = torch.optim.Adam
        if self.config.optimizer == "adamw":
            kind, options["weight_decay"] = torch.optim.AdamW, self.config.weight_decay
        self.optimizer = kind(self._parameters, lr=self._rate, fused=True, **options)

    def _allocate_minibatches(self) -> None:
        """Allocate the samples of each minibatch and the metrics of an update."""
        config, worlds, device = self.config, self.setting.share.count, self.device
        share = self.steps // config.minibatches
        self._orders = torch.zeros(config.epochs * config.minibatches, share, worlds, dtype=torch.long, device=device)
        self._scratch = torch.zeros(config.epochs, worlds, self.steps, dtype=torch.int32, device=device)
        self._rows = torch.zeros(share * worlds, dtype=torch.long, device=device)
        self._ones = torch.ones(share * worlds, device=device)
        self._loss_sums = torch.zeros(len(LOSSES), device=device)
        self._squares = torch.zeros(2, device=device)
        """Squared norms of the gradients of actor and critic."""
        self._norm_sum = torch.zeros((), device=device)
        self._metrics = torch.zeros(len(METRICS), device=device)

    def _make_graphs(self) -> list[CudaGraphFunction]:
        """The parts of learning that the device replays as graphs: all of it, or in a gang the parts between the collectives."""
        parts = (self._estimate, self._normalize, self._compute_gradients, self._apply_gradients, self._close)
        if self.gang.size == 1:
            self._parts: tuple[Callable[[], None], ...] = parts
            return [CudaGraphFunction(self._learn, self.device, "learning")]
        graphs = [CudaGraphFunction(part, self.device, part.__name__.strip("_").replace("_", " ")) for part in parts]
        self._parts = tuple(graphs)
        return graphs

    # -- collecting ---------------------------------------------------------------------------------------------------

    def begin(self, iteration: int) -> None:
        """Set the iteration of all further draws, and what depends on it: the limit of the rate, and whether the normalisers learn."""
        self._draws.begin(iteration)
        self.rollout.step = 0
        config = self.config
        self._normalizer_learns.fill_(config.normalizer_learns(iteration))
        if config.schedule == "adaptive" and config.learning_rate_horizon is not None:
            greatest = config.greatest_rate(iteration)
            self._greatest_rate.fill_(greatest)
            self._rate.clamp_(max=greatest)

    @torch.no_grad()
    def act(self, observations: TensorDict) -> torch.Tensor:
        """Actions, shape (worlds, actions); records them and the observations."""
        rollout, step = self.rollout, self.rollout.step
        if step == 0:
            self._head.begin()
        latents = rollout.actor.see(step, observations)
        if rollout.critic is not rollout.actor:
            rollout.critic.see(step, observations)
        outputs = rollout.outputs[step].copy_(self.actor.mlp(latents))
        return self._head.draw(self._draws, step, outputs, rollout.actions[step])

    def record(self, step: Transition) -> None:
        """Record the result of the step."""
        self.rollout.record(step)

    # -- learning -----------------------------------------------------------------------------------------------------

    def learn(self, observations: TensorDict) -> Mapping[str, torch.Tensor]:
        """Returns, advantages, and all epochs of minibatches; returns :data:`METRICS`."""
        for view in self.rollout.views:
            view.last.copy_(observations[view.group])
        if self.gang.size == 1:
            self.graphs[0]()
        else:
            self._learn()
        metrics = dict(zip(METRICS, self._metrics, strict=True))
        if not self._ranged:
            del metrics["saturation"]
        return metrics

    def _learn(self) -> None:
        estimate, normalize, compute, apply, close = self._parts
        estimate()
        self.gang.sum(self._sums.values)
        normalize()
        for rows in self._orders:
            self._rows.copy_(rows.view(-1))
            compute()
            self.gang.sum(self._shared)
            apply()
        self._gather_figures()
        self.gang.sum(self._figures.values)
        close()

    @torch.no_grad()
    def _estimate(self) -> None:
        """Compute values, advantages and moments of this rank's samples, and draw the minibatches."""
        rollout, critic = self.rollout, self.rollout.critic
        rollout.values.copy_(linear.forward(self.critic.mlp, critic.padded).squeeze(-1))
        last = self.critic.mlp(critic.latent(critic.last)).squeeze(-1)
        rollout.add_future(self.config.gamma, self.critic.mlp)
        rollout.log_prob.copy_(self._head.log_prob(rollout))
        rollout.estimate_advantages(last, self.config.gamma, self.config.lam)
        advantages = rollout.advantages
        self._sums["count"].fill_(advantages.numel())  # an assignment would copy from the host, which no graph holds
        self._sums["advantages"].copy_(advantages.sum(dtype=torch.float64))
        self._sums["squared_advantages"].copy_(advantages.double().square().sum())
        for view, normalizer, sums in self._normalised:
            gather_moments(view.observations, normalizer, sums)
        self._draws.order(self._orders, self._scratch)

    @torch.no_grad()
    def _normalize(self) -> None:
        """Normalise the advantages with the moments of all ranks."""
        count, total, squares = (self._sums[name][0] for name in _ADVANTAGES)
        mean = total / count
        deviation = ((squares - total * mean) / (count - 1)).clamp(min=0.0).sqrt()
        self.rollout.advantages.sub_(mean).div_(deviation + 1e-8)
        for buffer in (self._loss_sums, self._norm_sum, self._head.clipped):
            buffer.zero_()

    def _compute_gradients(self) -> None:
        """Gradients and losses of one minibatch, weighted by this rank's share of the samples."""
        self._shared.zero_()
        rollout = self.rollout
        latents = rollout.actor.batch(self._rows)
        critic = latents if rollout.critic is rollout.actor else rollout.critic.batch(self._rows)
        with self._beside() as join:
            values = linear.forward(self.critic.mlp, critic, self._ones)
        outputs = linear.forward(self.actor.mlp, latents, self._ones)
        join()
        self._losses.copy_(self._head.backward(self._rows, rollout, outputs, values))

    def _apply_gradients(self) -> None:
        """One step of the optimizer with the gradients and losses of all ranks."""
        self._loss_sums.add_(self._losses)
        self._adapt_learning_rate(self._losses[LOSSES.index("kl")])
        for gradient, square in zip(self._gradients, self._squares, strict=True):
            square.copy_(torch.dot(gradient, gradient))
        scales = (self.config.max_grad_norm / (self._squares.sqrt() + 1e-6)).clamp(max=1.0)
        self._norm_sum.add_(self._squares.sum().sqrt())
        for gradient, scale in zip(self._gradients, scales, strict=True):
            gradient.mul_(scale)
        self.optimizer.step()
        self._head.project()

    @torch.no_grad()
    def _gather_figures(self) -> None:
        """This rank's sums over the whole rollout, which only metrics need."""
        figures, rollout = self._figures, self.rollout
        figures["returns"].copy_(rollout.returns.sum(dtype=torch.float64))
        figures["squared_returns"].copy_(rollout.returns.double().square().sum())
        figures["clipped"].copy_(self._head.clipped.sum(dtype=torch.float64))
        if self._ranged:
            within = torch.clamp(rollout.actions, *self._ranges)
            figures["saturated"].copy_((within != rollout.actions).sum())

    @torch.no_grad()
    def _close(self) -> None:
        """After the last minibatch: update the normalisers and gather the metrics."""
        for _, normalizer, sums in self._normalised:
            merge_moments(normalizer, self._sums["count"][0], sums, self._normalizer_learns)
        torch.div(self._loss_sums, len(self._orders), out=self._metrics[: len(LOSSES)])
        count, total, squares = (self._sums[name][0] for name in _ADVANTAGES)
        figures, updates = self._figures, len(self._orders)
        spread = figures["squared_returns"][0] - figures["returns"][0].square() / count
        unexplained = squares - total.square() / count  # a return less its value is the advantage
        trained = updates * self._orders[0].numel() / self.rollout.advantages.numel() * count
        found = (
            self._rate,
            self._head.spread(),
            1.0 - unexplained / spread.clamp(min=1e-12),
            figures["clipped"][0] / trained,
            self._norm_sum / updates,
            figures["saturated"][0] / (count * max(1, self._ranged)),
        )
        for metric, value in zip(self._metrics[len(LOSSES) :], found, strict=True):
            metric.copy_(value)

    @contextlib.contextmanager
    def _beside(self) -> Iterator[Callable[[], None]]:
        """On a GPU, run the work in this context (and its backward pass) concurrently with the work after it, until the yielded function
        is called."""
        side = self._side
        if side is None:
            yield lambda: None
            return
        main = torch.cuda.current_stream()
        side.wait_stream(main)
        with torch.cuda.stream(side):
            yield lambda: main.wait_stream(side)

    @torch.no_grad()
    def _adapt_learning_rate(self, kl: torch.Tensor) -> None:
        if self.config.schedule != "adaptive":
            return
        least, _ = self.config.learning_rate_limits
        lower = (self._rate / RATE_STEP).clamp(min=least)
        higher = torch.minimum(self._rate * RATE_STEP, self._greatest_rate)
        small = (kl < self.config.desired_kl / 2.0) & (kl > 0.0)
        self._rate.copy_(torch.where(kl > self.config.desired_kl * 2.0, lower, torch.where(small, higher, self._rate)))

    # -- state --------------------------------------------------------------------------------------------------------

    def policy(self) -> ActorPolicy:
        """A view of the actor."""
        return self._policy

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimizer and learning rate."""
        return {
            "policy": self._policy.state_dict(),
            "critic": dict(self.critic.state_dict()),
            "optimizer": self.optimizer.state_dict(),
            "learning_rate": self._rate,
        }

    def load_state_dict(
        self, state: Mapping[str, Any], *, weights_only: bool = False, changed: Collection[str] = ()
    ) -> list[str]:
        """Continue from :meth:`state_dict`; returns a line if the learning rate differs from the saved one.

        A fixed rate is always the configured one. An adaptive rate is the saved one unless this job configures another, so that the run
        continues as if it had never stopped.
        """
        self._policy.load_state_dict(state["policy"])
        self._head.project()
        self.critic.load_state_dict(state["critic"])
        if weights_only:
            return []
        load_optimizer(self.optimizer, state["optimizer"])
        saved, configured = float(state["learning_rate"]), self.config.learning_rate
        keeps = self.config.schedule == "adaptive" and "learning_rate" not in changed
        self._rate.fill_(saved if keeps else configured)
        return [] if keeps or saved == float(self._rate) else [f"learning rate set to {configured:g}"]

    def world_state(self) -> dict[str, torch.Tensor]:
        """Empty: no state per world outlasts an iteration."""
        return {}

    def load_world_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """No-op: there is no state per world."""

    @classmethod
    def build_policy(cls, config: PPOConfig, spaces: Spaces, device: str) -> ActorPolicy:
        """The actor alone."""
        actor = build_actor(config, spaces).to(device)
        return ActorPolicy(actor.eval(), spaces)
