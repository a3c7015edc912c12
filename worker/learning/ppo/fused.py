"""PPO over a gang of ranks that computes what one rank with all the worlds would compute.

rsl-rl's PPO is subclassed at its seams, with rsl-rl's models, distribution and storage. What differs from rsl-rl 5.5.1, and why:

- Advantage moments, observation moments, gradients, KL and losses are sums over all ranks' samples, so that the number of
  ranks changes nothing but rounding. One collective an iteration, one a minibatch.
- A time-out bootstraps from the value of the observation *after* the step, before the reset; rsl-rl takes the one before the step.
  (Of images there is none after the step: there it is as in rsl-rl.)
- Values and log-probabilities are computed in one pass over the finished rollout, not step by step.
- Every epoch draws a new permutation (rsl-rl draws one and repeats the same minibatches in all epochs).
- The objective and its gradient are one kernel (:mod:`worker.learning.ppo.objective`), and on CUDA actor and critic run side by side.
- The learning rate is a tensor and its rule runs on the device. Nothing here waits for the device, and on CUDA all of
  :meth:`PPO.learn` is one graph.
- Action noise depends on (seed, iteration, step, global world index) alone: not on the number of ranks, nor on a restart.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from rsl_rl.algorithms.ppo import PPO as RslPPO
from rsl_rl.storage.rollout_storage import RolloutStorage

from worker.distributed import Gang
from worker.learning.algorithm import Share
from worker.learning.ppo import linear, moments
from worker.learning.ppo.models import GROUP, build_models, example_observations
from worker.learning.ppo.objective import LOSSES, Objective
from worker.learning.randomness import mix_seed
from worker.learning.recording import Recorded

if TYPE_CHECKING:
    from worker.learning.ppo.settings import PPOConfig

COLLECTIVES_IN_GRAPH = True
"""Whether a gang's collectives are part of the graph of learning, or stand between smaller graphs."""
RATE_LIMITS = (1e-5, 1e-2)
RATE_STEP = 1.5
"""rsl-rl's adaptive rule: divide the learning rate above 2 × the desired KL, multiply it below half, within these limits."""


class PPO(RslPPO):
    """Collects with :meth:`act` and :meth:`process_env_step`, then :meth:`learn`."""

    def __init__(
        self,
        config: PPOConfig,
        share: Share,
        observation_shape: Sequence[int],
        action_size: int,
        gang: Gang,
        *,
        seed: int = 0,
        extras: int = 0,
    ) -> None:
        """Allocate everything once.

        Args:
            config: Hyperparameters.
            share: The worlds of this rank.
            observation_shape: Shape of one observation: ``(size,)``, or ``(channels, height, width)`` of an image of bytes.
            action_size: Length of one action.
            gang: The ranks that learn together.
            seed: Of action noise and minibatch order; weights come from torch's own generator.
            extras: Length of :attr:`extra`.

        Raises:
            ValueError: Fewer samples an iteration than minibatches on some rank.
        """
        device, worlds, steps = gang.device, share.count, config.steps
        smallest = min(Share.of(r, gang.size, share.total).count for r in range(gang.size)) * steps
        if smallest < config.minibatches:
            raise ValueError(
                f"ppo.minibatches: {config.minibatches} minibatches need as many samples, a rank collects {smallest}"
            )
        self._rate = torch.tensor(config.learning_rate, device=device)
        storage = RolloutStorage(
            "rl", worlds, steps, example_observations(worlds, observation_shape, device), [action_size], device
        )
        with warnings.catch_warnings():  # of convolutions that are both models'; the optimizer is replaced below
            warnings.filterwarnings("ignore", "optimizer contains a parameter group with duplicate parameters")
            super().__init__(
                *build_models(config, observation_shape, action_size),
                storage,
                num_learning_epochs=config.epochs,
                num_mini_batches=config.minibatches,
                clip_param=config.clip,
                gamma=config.gamma,
                lam=config.lam,
                value_loss_coef=config.value_loss_coef,
                entropy_coef=config.entropy_coef,
                learning_rate=config.learning_rate,
                max_grad_norm=config.max_grad_norm,
                schedule=config.schedule,
                desired_kl=config.desired_kl,
                device=device,
            )
        self.gang, self.share, self.seed = gang, share, seed
        self._allocate_rollout(worlds, steps, observation_shape, action_size, extras)
        self._allocate_gradients()
        counts = [Share.of(r, gang.size, share.total).count * steps // config.minibatches for r in range(gang.size)]
        self._batch = share.count * steps // config.minibatches
        self._side = torch.cuda.Stream(device) if device.startswith("cuda") else None
        self._objective = Objective(
            self._batch,
            action_size,
            device,
            weight=self._batch / sum(counts),
            clip=config.clip,
            value_coef=config.value_loss_coef,
            entropy_coef=config.entropy_coef,
        )
        self._allocate_minibatches()

    def _allocate_rollout(
        self, worlds: int, steps: int, observation_shape: Sequence[int], actions: int, extras: int
    ) -> None:
        def empty(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(shape, device=self.device, dtype=dtype)

        self._observations = self.storage.observations[GROUP]
        self._images: torch.Tensor | None = None
        if len(observation_shape) > 1:
            self._images = self._observations.flatten(0, 1)
        features = self.actor._get_latent_dim()
        self._latents = empty(steps, worlds, features)
        self._terminal = empty(steps, worlds, features if self._images is None else 0)
        self._time_outs = empty(steps, worlds, 1)
        self._std = empty(actions)
        mean = empty(steps, worlds, actions)
        self.storage.distribution_params = (mean, self._std.expand_as(mean))
        self._noise = empty(steps, self.share.total, actions)
        self._noise_source = torch.Generator(self.device)
        self._order_source = torch.Generator(self.device)
        self._last_observations = torch.zeros_like(self._observations[0])
        end = 3 + (2 * features if self.actor.obs_normalization else 0)
        self._sums = empty(end + extras, dtype=torch.float64)
        self._observation_sums = self._sums[3:end]
        self.extra = self._sums[end:]
        """The caller's own numbers, shape (extras,), float64: :meth:`compute_returns` sums them over the ranks."""

    def _allocate_gradients(self) -> None:
        """One flat buffer: all gradients, then what else a minibatch shares. The parameters' gradients are views of it."""
        actor = list(self.actor.parameters())
        shared = set(map(id, actor))  # convolutions are the actor's too
        critic = [parameter for parameter in self.critic.parameters() if id(parameter) not in shared]
        sizes = [sum(p.numel() for p in part) for part in (actor, critic)]
        self._shared = torch.zeros(sum(sizes) + len(LOSSES), device=self.device)
        offset = 0
        for parameter in actor + critic:
            parameter.grad = self._shared[offset : offset + parameter.numel()].view_as(parameter)
            offset += parameter.numel()
        self._gradients = self._shared[: sizes[0]], self._shared[sizes[0] : sum(sizes)]
        self._losses = self._shared[sum(sizes) :]
        self._loss_sums = torch.zeros(len(LOSSES), device=self.device)
        cuda = self.device.startswith("cuda")
        self.optimizer = torch.optim.Adam(
            actor + critic, lr=self._rate, fused=True, **({"capturable": True} if cuda else {})
        )

    def _allocate_minibatches(self) -> None:
        """Which samples each minibatch has; and what of learning the device replays as graphs."""
        count = self.num_learning_epochs * self.num_mini_batches
        self._orders = torch.zeros(count, self._batch, dtype=torch.long, device=self.device)
        self._rows = torch.zeros(self._batch, dtype=torch.long, device=self.device)
        self._losses_mean = torch.zeros(len(LOSSES), device=self.device)
        parts = (
            self._estimate,
            self._normalize_advantages,
            self._compute_gradients,
            self._apply_gradients,
            self._close,
        )
        if COLLECTIVES_IN_GRAPH or self.gang.size == 1:
            self.recordings = [Recorded(self._learn, self.device, "learning")]
        else:
            self.recordings = [
                Recorded(part, self.device, part.__name__.strip("_").replace("_", " ")) for part in parts
            ]
        """What is recorded, for the run's log."""
        self._parts: Sequence[Callable[[], None]] = parts if len(self.recordings) == 1 else self.recordings

    @property
    def learning_rate(self) -> float:
        """The learning rate now. Reading it waits for the device."""
        return float(self._rate)

    @learning_rate.setter
    def learning_rate(self, value: float | torch.Tensor) -> None:
        self._rate.fill_(value)

    @property
    def learning_rate_tensor(self) -> torch.Tensor:
        """The learning rate, shape (), on the device."""
        return self._rate

    @property
    def action_std(self) -> torch.Tensor:
        """Mean over the action's components of the deviation of the last rollout, shape (), on the device."""
        return self._std.mean()

    # -- collecting ---------------------------------------------------------------------------------------------------

    def begin_iteration(self, iteration: int) -> None:
        """Draw this iteration's noise (the same on all ranks) and minibatches (a rank's own)."""
        self._noise_source.manual_seed(mix_seed(self.seed, iteration, 0))
        self._order_source.manual_seed(mix_seed(self.seed, iteration, 1, self.gang.rank))
        torch.randn(self._noise.shape, generator=self._noise_source, out=self._noise)
        for epoch in self._orders.view(self.num_learning_epochs, -1):
            order = torch.randperm(
                self.share.count * self.storage.num_transitions_per_env,
                generator=self._order_source,
                device=self.device,
            )
            epoch.copy_(order[: len(epoch)])
        self.storage.clear()
        distribution = self.actor.distribution
        with torch.no_grad():
            distribution.update(self.storage.distribution_params[0][0])
            self._std.copy_(distribution.std[0])

    @torch.no_grad()
    def act(self, observations: torch.Tensor) -> torch.Tensor:
        """Actions, shape (worlds, actions), for ``observations``, shape (worlds, *observation_shape); both are recorded."""
        step = self.storage.step
        self._observations[step].copy_(observations)
        latent = self._latents[step].copy_(self.actor.get_latent({GROUP: observations}))
        mean = self.storage.distribution_params[0][step].copy_(self.actor.mlp(latent))
        noise = self._noise[step, self.share.first : self.share.first + self.share.count]
        return torch.addcmul(mean, self._std, noise, out=self.storage.actions[step])

    @torch.no_grad()
    def act_mean(self, observations: torch.Tensor) -> torch.Tensor:
        """The policy without noise, as it is exported; nothing is recorded."""
        return self.actor.mlp(self.actor.get_latent({GROUP: observations}))

    def process_env_step(
        self, terminal_observations: torch.Tensor, rewards: torch.Tensor, dones: torch.Tensor, time_outs: torch.Tensor
    ) -> None:
        """Record what the step did.

        Args:
            terminal_observations: The observation before the reset, shape (worlds, observations), where ``dones``; not used
                where observations are images, of which none is taken then: the last one before the step stands for it.
            rewards: Shape (worlds,).
            dones: The episode ended, for any reason, shape (worlds,).
            time_outs: It ended by the clock alone, shape (worlds,).
        """
        step = self.storage.step
        if self._images is None:
            self._terminal[step].copy_(terminal_observations)
        self.storage.rewards[step, :, 0].copy_(rewards)
        self.storage.dones[step, :, 0].copy_(dones)
        self._time_outs[step, :, 0].copy_(time_outs)
        self.storage.step += 1

    # -- learning -----------------------------------------------------------------------------------------------------

    def learn(self, observations: torch.Tensor) -> torch.Tensor:
        """:meth:`compute_returns`, then :meth:`update`, as one recording; returns the mean :data:`LOSSES`, shape (4,)."""
        self._last_observations.copy_(observations)
        if len(self.recordings) == 1:
            self.recordings[0]()
        else:
            self._learn()
        return self._losses_mean

    def _learn(self) -> None:
        self.compute_returns(self._last_observations)
        self.update()

    def compute_returns(self, observations: torch.Tensor) -> None:
        """Values, GAE (Schulman et al. 2015, arXiv:1506.02438, eq. 16) and advantages normalised over all ranks' samples.

        Args:
            observations: After the last step, shape (worlds, observations).
        """
        if observations is not self._last_observations:
            self._last_observations.copy_(observations)
        estimate, normalize, *_ = self._parts
        estimate()
        self.gang.sum(self._sums)
        normalize()

    @torch.no_grad()
    def _estimate(self) -> None:
        """Values and advantages of this rank's samples, and their moments."""
        st = self.storage
        st.values.copy_(self.critic.mlp(self._latents))
        last = self.critic.mlp(self.critic.get_latent({GROUP: self._last_observations}))
        self._bootstrap()
        self.actor.distribution.update(st.distribution_params[0])
        st.actions_log_prob[..., 0].copy_(self.actor.distribution.log_prob(st.actions))
        going_on = 1.0 - st.dones.float()
        next_values = torch.cat((st.values[1:], last.unsqueeze(0)))
        delta = st.rewards + self.gamma * going_on * next_values - st.values
        decay = going_on.mul_(self.gamma * self.lam)
        st.advantages[-1].copy_(delta[-1])
        for step in range(st.num_transitions_per_env - 2, -1, -1):
            torch.addcmul(delta[step], decay[step], st.advantages[step + 1], out=st.advantages[step])
        torch.add(st.advantages, st.values, out=st.returns)
        self._gather_moments()

    @torch.no_grad()
    def _normalize_advantages(self) -> None:
        """By the moments over all ranks; then all is ready for the minibatches."""
        st = self.storage
        count, total, squares = self._sums[0], self._sums[1], self._sums[2]
        mean = total / count
        deviation = ((squares - total * mean) / (count - 1)).clamp(min=0.0).sqrt()
        st.advantages.sub_(mean).div_(deviation + 1e-8)
        self._loss_sums.zero_()

    def _bootstrap(self) -> None:
        """Where an episode was cut by the clock, its future is the value of the observation at which it was cut."""
        if self._images is not None:
            self.storage.rewards.addcmul_(self._time_outs, self.storage.values, value=self.gamma)
            return
        if self.device == "cpu":
            rows = self._time_outs.flatten().nonzero().squeeze(1)
            if len(rows):
                values = self.critic.mlp(self.critic.get_latent({GROUP: self._terminal.flatten(0, 1)[rows]}))
                self.storage.rewards.view(-1, 1).index_add_(0, rows, values, alpha=self.gamma)
            return
        values = self.critic.mlp(self.critic.get_latent({GROUP: self._terminal}))
        future = torch.where(
            self._time_outs > 0, values, torch.zeros_like(values)
        )  # the other rows may hold anything, NaN too
        self.storage.rewards.add_(future, alpha=self.gamma)

    def _gather_moments(self) -> None:
        """Count, sum and sum of squares of advantages and of observations, beside the caller's extras, to be summed over the ranks."""
        advantages = self.storage.advantages
        self._sums[0].fill_(advantages.numel())  # an assignment would copy from the host, which no graph holds
        self._sums[1] = advantages.sum(dtype=torch.float64)
        self._sums[2] = advantages.double().square().sum()
        if self.actor.obs_normalization:
            moments.gather(self._observations, self.actor.obs_normalizer, self._observation_sums)

    def update(self) -> torch.Tensor:
        """All epochs and minibatches; returns the mean :data:`LOSSES`, shape (4,), on the device."""
        *_, compute, apply, close = self._parts
        for rows in self._orders:
            self._rows.copy_(rows)
            compute()
            self.gang.sum(self._shared)
            apply()
        close()
        return self._losses_mean

    def _apply_gradients(self) -> None:
        """One step of Adam with the gradients and losses of all ranks."""
        self._loss_sums.add_(self._losses)
        self._adapt_learning_rate(self._losses[LOSSES.index("kl")])
        for gradient in self._gradients:
            norm = torch.dot(gradient, gradient).sqrt()
            gradient.mul_((self.max_grad_norm / (norm + 1e-6)).clamp(max=1.0))
        self.optimizer.step()

    def _close(self) -> None:
        """After the last minibatch."""
        if self.actor.obs_normalization:
            with torch.no_grad():
                moments.merge(self.actor.obs_normalizer, self._sums[0], self._observation_sums)
        torch.div(self._loss_sums, len(self._orders), out=self._losses_mean)

    def _compute_gradients(self) -> None:
        """Of one minibatch, weighted by this rank's part of the samples."""
        self._shared.zero_()
        st, distribution = self.storage, self.actor.distribution
        if self._images is None:
            latents = self._latents.flatten(0, 1)[self._rows]
        else:
            latents = self.actor.get_latent({GROUP: self._images[self._rows]})
        with self._beside() as join:
            values = linear.forward(self.critic.mlp, latents)
        mean = linear.forward(self.actor.mlp, latents)
        join()
        losses = self._objective.backward(
            self._rows,
            (
                st.actions.flatten(0, 1),
                st.distribution_params[0].flatten(0, 1),
                *(each.flatten() for each in (st.actions_log_prob, st.advantages, st.returns, st.values)),
            ),
            self._std,
            mean,
            distribution.std_param.clamp(*distribution.std_range),
            values,
        )
        self._losses.copy_(losses)

    @contextlib.contextmanager
    def _beside(self) -> Iterator[Callable[[], None]]:
        """On a GPU, what is in this context runs beside what follows (and so does its backward pass), until what it yields is called."""
        if self._side is None:
            yield lambda: None
            return
        main = torch.cuda.current_stream()
        self._side.wait_stream(main)
        with torch.cuda.stream(self._side):
            yield lambda: main.wait_stream(self._side)

    @torch.no_grad()
    def _adapt_learning_rate(self, kl: torch.Tensor) -> None:
        if self.schedule != "adaptive":
            return
        lower = (self._rate / RATE_STEP).clamp(min=RATE_LIMITS[0])
        higher = (self._rate * RATE_STEP).clamp(max=RATE_LIMITS[1])
        small = (kl < self.desired_kl / 2.0) & (kl > 0.0)
        self._rate.copy_(torch.where(kl > self.desired_kl * 2.0, lower, torch.where(small, higher, self._rate)))

    # -- state --------------------------------------------------------------------------------------------------------

    def broadcast_parameters(self) -> None:
        """Give every rank the main rank's weights."""
        for parameter in (*self.actor.parameters(), *self.critic.parameters()):
            self.gang.broadcast(parameter.data)

    def load(self, loaded_dict: dict, load_cfg: dict | None = None, strict: bool = True) -> bool:
        """Load what :meth:`save` returned; the optimizer goes on reading the one learning-rate tensor."""
        result = super().load(loaded_dict, load_cfg, strict)
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate
        return result
