"""Training: the same sessions, plan and seed give the same weights on one machine, interrupted or not."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from operators.kpconv.classifier import classifier_of
from operators.kpconv.frames import Frames
from operators.kpconv.plan import WARM_UP, Plan
from operators.kpconv.settings import CLASSES, Settings
from operators.kpconv.spheres import IGNORED
from operators.kpconv.weights import WeightsError, fill, read, recipe_of, save

AHEAD = 4  # batches that are made while one is learned from
UNTIMED = 5  # first steps that do not count for a budget: compilers and caches warm up
REPORT = 10  # steps between two entries of the history
CHECKED_FRAMES = 24  # of the held-out session


class Checkpoint(msgspec.Struct, forbid_unknown_fields=True):
    """What is needed, beside tensors, to go on as if nothing had happened."""

    settings: Settings
    plan: Plan
    step: int  # the next
    history: list[dict[str, Any]]
    best: float = -1.0  # mean recall on the held-out session
    best_step: int = -1
    stale: int = 0  # looks since then
    seconds: float = 0.0


class Progress(msgspec.Struct, frozen=True):
    """What a training run says now and then."""

    step: int
    steps: int
    loss: float
    recall: dict[str, float]
    frames_per_second: float  # spheres or windows
    waiting: float  # share of the time in which the next batch was not ready
    seconds_left: float


class Group:
    """This process among those that train together."""

    def __init__(self, *, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    def agree(self, value: float) -> float:
        """Take the first process's value."""
        if self.size == 1:
            return value
        shared = torch.tensor([value], dtype=torch.float64)
        distributed.broadcast(shared, 0)
        return float(shared)

    def total(self, counts: Tensor) -> Tensor:
        """Sum over the processes."""
        if self.size > 1:
            distributed.all_reduce(counts)
        return counts


class Trainer:
    """A network on its way. held_out: frames of sessions that are not trained on; without them nothing stops early."""

    def __init__(
        self,
        settings: Settings,
        plan: Plan,
        frames: Frames,
        *,
        held_out: Frames | None = None,
        device: torch.device | str = "cpu",
        group: Group | None = None,
    ) -> None:
        self.recipe = recipe_of(settings)
        self.frames, self.held_out = frames, held_out
        self.device, self.group = torch.device(device), group or Group()
        self.state = Checkpoint(settings, plan, 0, [])
        torch.manual_seed(plan.seed)
        self.network = self.recipe.network().to(self.device)
        self.model: nn.Module = self.network
        if self.group.size > 1:
            self.model = DistributedDataParallel(self.network)
        self.optimizer = self.make_optimizer(plan)
        self.best: dict[str, Tensor] = {}
        self.confusion = torch.zeros(len(CLASSES), len(CLASSES), dtype=torch.int64)
        self.loss, self.waited = 0.0, 0.0

    def make_optimizer(self, plan: Plan) -> torch.optim.Optimizer:
        """Return the plan's optimizer."""
        if plan.optimizer == "sgd":
            return torch.optim.SGD(
                self.network.parameters(), lr=plan.rate, momentum=plan.momentum, weight_decay=plan.decay
            )
        return torch.optim.AdamW(self.network.parameters(), lr=plan.rate, weight_decay=plan.decay)

    @property
    def plan(self) -> Plan:
        """Return the plan, whose number of steps a budget may have set."""
        return self.state.plan

    def batch(self, step: int) -> Any:
        """Make this process's part of a step's batch: a function of seed, step and rank alone."""
        mine = range(self.group.rank, self.plan.batch, self.group.size)
        draws = [np.random.default_rng([self.plan.seed, step, number]) for number in mine]
        samples = [self.recipe.sample(self.frames, draw) for draw in draws]
        return self.recipe.collate(cast(Any, samples), self.device)

    def learn(self, batch: Any) -> float:
        """Take one step; returns the loss."""
        inputs, targets = batch
        self.model.train()
        for options in self.optimizer.param_groups:
            options["lr"] = self.plan.rate_at(self.state.step)
        for module in self.network.modules():
            if isinstance(module, (nn.BatchNorm1d, nn.BatchNorm2d)):
                module.momentum = self.plan.statistics_at(self.state.step)
        self.optimizer.zero_grad()
        logits = self.model(inputs)
        loss = nn.functional.cross_entropy(logits, targets, self.weights_of(targets), ignore_index=IGNORED)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        known = targets != IGNORED
        pairs = targets[known] * len(CLASSES) + logits.detach().argmax(1)[known]
        self.confusion += torch.bincount(pairs.cpu(), minlength=len(CLASSES) ** 2).view_as(self.confusion)
        return float(loss.detach())

    def weights_of(self, targets: Tensor) -> Tensor:
        """Return a weight for each class: rarer ones get more."""
        counts = torch.bincount(targets[targets != IGNORED], minlength=len(CLASSES)).clamp(min=1)
        return (counts.sum() / counts).float() ** self.plan.balance

    def batches(self) -> Iterator[tuple[Any, float]]:
        """Yield each step's batch and the seconds that it was waited for; batches are made ahead by another thread."""
        with ThreadPoolExecutor(1, thread_name_prefix="batches") as maker:
            waiting: deque[Future[Any]] = deque()
            following = self.state.step
            try:
                while self.state.step < self.plan.steps:
                    while len(waiting) < AHEAD and following < self.plan.steps:
                        waiting.append(maker.submit(self.batch, following))
                        following += 1
                    begin = time.monotonic()
                    batch = waiting.popleft().result()
                    yield batch, time.monotonic() - begin
            finally:
                for future in waiting:
                    future.cancel()

    def run(
        self,
        *,
        budget: float | None = None,
        tell: Callable[[Progress], None] = lambda progress: None,
        checkpoint: Path | None = None,
        save_every: float = 60.0,
        stop_at: int | None = None,
    ) -> Checkpoint:
        """Train to the end of the plan, or until the held-out session gets no better.

        budget: seconds; sets the plan's number of steps by the time that the first ones take. checkpoint: file that is
        written every `save_every` seconds. stop_at: step before which to pause, for tests.
        """
        begin, timed, saved = time.monotonic(), 0.0, time.monotonic()
        before = self.state.seconds
        interval, interval_steps, waited = time.monotonic(), 0, 0.0
        for batch, seconds in self.batches():
            started = time.monotonic()
            self.loss += self.learn(batch)
            waited += seconds
            self.state.step += 1
            interval_steps += 1
            timed += time.monotonic() - started + seconds if self.state.step > UNTIMED else 0.0
            self.state.seconds = before + time.monotonic() - begin
            if budget is not None and self.state.step == WARM_UP:
                self.fit(budget - self.state.seconds, timed / (WARM_UP - UNTIMED))
            if self.state.step % REPORT == 0 or self.state.step == self.plan.steps:
                spent = time.monotonic() - interval
                tell(self.report(interval_steps, spent, waited))
                interval, interval_steps, waited = time.monotonic(), 0, 0.0
            last = self.state.step == self.plan.steps
            if self.held_out is not None and (self.state.step % self.plan.check == 0 or last) and self.look():
                break
            if checkpoint is not None and self.group.rank == 0 and time.monotonic() - saved > save_every:
                self.write(checkpoint)
                saved = time.monotonic()
            if self.state.step == stop_at:
                break
        if checkpoint is not None and self.group.rank == 0:
            self.write(checkpoint)
        return self.state

    def fit(self, seconds: float, each: float) -> None:
        """Set the number of steps to what fits into so many seconds, looks at the held-out session included."""
        look = 0.0
        if self.held_out is not None:
            begin = time.monotonic()
            self.recalls()
            look = (time.monotonic() - begin) / self.plan.check
        steps = self.group.agree(WARM_UP + max(0, int((seconds - look * self.plan.check) / (each + look))))
        self.state.plan = msgspec.structs.replace(self.plan, steps=int(steps))

    def report(self, steps: int, seconds: float, waited: float) -> Progress:
        """Sum up the last steps, into the history too."""
        counts = self.group.total(self.confusion)
        right, rows = counts.diagonal().double(), counts.sum(1).double()
        recall = {name: float(right[i] / rows[i]) for i, name in enumerate(CLASSES) if rows[i] > 0}
        loss = self.loss / max(1, steps)
        self.state.history.append({"step": self.state.step, "loss": loss, "recall": recall})
        self.confusion, self.loss = torch.zeros_like(counts), 0.0
        left = (self.plan.steps - self.state.step) * seconds / max(1, steps)
        rate = steps * self.plan.batch / max(seconds, 1e-9)
        return Progress(self.state.step, self.plan.steps, loss, recall, rate, waited / max(seconds, 1e-9), left)

    def recalls(self) -> dict[str, float]:
        """Return the recall of each class on whole frames of the held-out session, and their mean."""
        assert self.held_out is not None
        classifier = classifier_of(self.network, self.state.settings, torch.float32)
        right, all_ = np.zeros(len(CLASSES) + 1), np.zeros(len(CLASSES) + 1)
        count = min(CHECKED_FRAMES, len(self.held_out))
        for number in np.linspace(0, len(self.held_out) - 1, count).astype(int):
            frame = self.held_out[int(number)]
            base_from_lidar = np.eye(4)
            base_from_lidar[:3, 3] = frame.origin
            points = (frame.points - frame.origin).astype(np.float32)
            labels, _ = classifier.classify(points, base_from_lidar, frame.ring).full()
            all_ += np.bincount(frame.labels, minlength=len(all_))
            right += np.bincount(frame.labels[labels == frame.labels], minlength=len(all_))
        found = {name: float(right[i] / all_[i]) for i, name in enumerate(CLASSES, 1) if all_[i]}
        return found | {"mean": float(np.mean(list(found.values()))) if found else 0.0}

    def look(self) -> bool:
        """Look at the held-out session, keep the weights if they are the best; say whether to stop."""
        recalls = self.recalls() if self.group.rank == 0 else {"mean": 0.0}
        mean = self.group.agree(recalls["mean"])
        state = self.state
        if state.history and state.history[-1]["step"] == state.step:
            state.history[-1]["held_out"] = recalls
        else:
            state.history.append({"step": state.step, "loss": float("nan"), "recall": {}, "held_out": recalls})
        if mean > state.best:
            state.best, state.best_step, state.stale = mean, state.step, 0
            self.best = {name: tensor.detach().cpu().clone() for name, tensor in self.network.state_dict().items()}
        else:
            state.stale += 1
        return state.stale >= self.plan.patience

    def weights(self) -> dict[str, Tensor]:
        """Return the best weights on the held-out session, or the last where there is none."""
        return self.best or self.network.state_dict()

    def write(self, path: Path) -> None:
        """Write a checkpoint."""
        tensors = {f"network.{name}": tensor for name, tensor in self.network.state_dict().items()}
        tensors |= {f"best.{name}": tensor for name, tensor in self.best.items()}
        for number, entry in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{number}.{key}": torch.as_tensor(value) for key, value in entry.items()}
        save(path, tensors, self.state)

    def resume(self, path: Path) -> None:
        """Go on where a checkpoint was written. Raises WeightsError that names the first setting which differs."""
        tensors, state = read(path, Checkpoint)
        for kind, mine in (("settings", self.state.settings), ("plan", self.plan)):
            theirs = getattr(state, kind)
            for name in mine.__struct_fields__:
                if name != "steps" and getattr(mine, name) != getattr(theirs, name):
                    given, wanted = getattr(mine, name), getattr(theirs, name)
                    raise WeightsError(f"{path} was written with {name} = {wanted}; now {given} is given")
        parts: dict[str, dict[str, Tensor]] = {"network": {}, "best": {}, "optimizer": {}}
        for name, tensor in tensors.items():
            part, _, rest = name.partition(".")
            parts[part][rest] = tensor
        fill(self.network, parts["network"], path)
        self.best, self.state = parts["best"], state
        optimizer = self.optimizer.state_dict()
        entries: dict[int, dict[str, Tensor]] = {}
        for name, tensor in parts["optimizer"].items():
            number, _, key = name.partition(".")
            entries.setdefault(int(number), {})[key] = tensor
        self.optimizer.load_state_dict({"state": entries, "param_groups": optimizer["param_groups"]})
