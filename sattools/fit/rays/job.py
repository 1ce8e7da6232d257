"""The training of a field on rays from the first step to the last: checkpoints, and what a budget has room for."""

from __future__ import annotations

import functools
import logging
import math
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from sattools.field.mlp import MlpField
from sattools.fit.options import FitOptions
from sattools.fit.rays.judge import AT_ONCE, RAYS, held_out_losses, judge_heights
from sattools.fit.rays.maps import read_maps, rows_at_once
from sattools.fit.rays.trainer import RayTrainer
from sattools.fit.resume import Interrupted
from sattools.fit.trace import Row, Trace
from sattools.progress import Progress, duration, subprogress
from sattools.scene import Grid
from sattools.scene.jsonio import JsonObject

log = logging.getLogger(__name__)
ROWS, SAVE_EVERY = 20, 5  # rows of the trace per fit; checkpoints among them
TELL_EVERY_S, SAVE_EVERY_S = 1.0, 30.0
ROWS_TRIED = 4  # at least, to know how long reading all off takes
TRIAL = 5  # steps after which it is known how long one takes
# and after ten times as many again, and so on: the first compile, meet cold memory, or are recorded for a GPU
TRIALS = tuple(TRIAL * 10**k for k in range(6))
LONG_S = 1200.0
BUDGET_SHARE = 0.93  # of the budget


@dataclass
class RayJob:
    """One fit of a field from the first step to the last, with checkpoints.

    Attributes:
        path, fingerprint: of the checkpoint.
        trainer: of the field.
        grid, z_range: where its surface is read off to be scored.
        trace: of the fit.
        basis: of the checkpoint, too.
    """

    path: Path
    fingerprint: str
    trainer: RayTrainer
    grid: Grid
    z_range: tuple[float, float]
    trace: Trace
    basis: JsonObject | None = None
    _foretold: bool = False

    def run(self, options: FitOptions, progress: Progress) -> list[str]:
        """Train; notes."""
        trace, trainer = self.trace, self.trainer
        start = self._begin(options)
        notes, step_s = self._begin_within(options, start), 0.0
        if options.budget and (start or trainer.at_rest) and self._is_over(options, self._foreseen_s):
            return [self._stopped(options, start, None if trace.rows else self._first_loss()), *notes]
        planned_at = start
        every = max(1, min(options.steps // ROWS, 500))
        told = saved_at = asked_s = timed_s = trace.seconds()
        asked_at = timed_at = start
        total, count = float(trainer.unsaid[0]), int(trainer.unsaid[1])
        watch = subprogress(progress, 0.0, 0.95)
        for number in range(start, options.steps):
            if options.budget and number - planned_at in TRIALS and planned_at in (start, trainer.rest_from):
                self._plan_within(options, number, number - asked_at, asked_s)
                asked_at, asked_s = number, trace.seconds()
            if number and self._is_to_ask(number, options, step_s):
                notes += judge_heights(trainer, number)
                self._forget()
                if self._is_over(options, step_s):
                    return [self._stopped(options, number, total / count if count else None), *notes]
                planned_at, asked_at, asked_s = number, number, trace.seconds()
            begun = trace.seconds()
            loss = trainer.step(number)
            total, count = total + loss, count + 1
            done, now = number + 1, trace.seconds()
            step_s = now - begun
            if done == planned_at + 1:  # it compiles, and says nothing about the others
                timed_at, timed_s = done, now
            over = done < options.steps and not self._may_rest and self._is_over(options, step_s)
            if done % every == 0 or done == options.steps or over:
                row: Row = {"seconds": round(now, 3), "step": done, "loss": total / count}
                trace.rows.append(row | self._score(options.reference))
                total, count = 0.0, 0
            if now - told >= TELL_EVERY_S or not count or over:
                told = now
                left = (now - timed_s) / max(done - timed_at, 1) * (trainer.steps - done)
                about = f"about {duration(left)} left, " if done > timed_at else ""
                share = max(done / trainer.steps, now / (options.budget or math.inf))
                watch(min(1.0, share), f"step {done}/{trainer.steps}, {about}loss {loss:.5f}")
                if done > timed_at:
                    self._foretell(left, now - timed_s, options)
            due = done % (SAVE_EVERY * every) == 0 or trace.seconds() - saved_at >= SAVE_EVERY_S
            if due and done < options.steps and not over:
                saved_at = trace.seconds()
                trainer.unsaid = torch.tensor([total, count], dtype=torch.float64, device="cpu")
                self._save(done, saved_at)
            if over:
                return [self._stopped(options, done, None), *notes]
        return notes

    def _foretell(self, left: float, timed_s: float, options: FitOptions) -> None:
        """Say once how long a long fit takes.

        Args:
            left: seconds until its end.
            timed_s: seconds of the steps by which that is known.
            options: of the fit.
        """
        if self._foretold or timed_s < TELL_EVERY_S:
            return
        self._foretold = True
        if left > LONG_S and not options.budget:
            log.warning("this fit takes about %s; --budget SECONDS ends it in time", duration(left))

    def _begin(self, options: FitOptions) -> int:
        """Plan all steps, and take what an interrupted run has left, if this one goes on with it; its steps."""
        self.trainer.plan(options.steps)
        saved = Interrupted.load(self.path, self.fingerprint) if options.resume else None
        if saved is None:
            return 0
        self.trainer.load(saved.tensors)
        self.trace.go_on(saved.rows, saved.seconds)
        if not options.budget:  # that of the interrupted run, if it had one, had planned fewer steps
            self.trainer.plan(options.steps)
        return saved.step

    def _save(self, done: int, seconds: float) -> None:
        """Leave a checkpoint after so many steps and seconds."""
        state, basis = self.trainer.state(), self.basis or {}
        rows = self.trace.rows
        Interrupted(state, self.fingerprint, rows, step=done, basis=basis, seconds=seconds).save(self.path)

    def _stopped(self, options: FitOptions, done: int, loss: float | None) -> str:
        """That the training was stopped, with a last row of the trace if there is a loss to tell."""
        if loss is not None:
            self.trace.rows.append({"seconds": round(self.trace.seconds(), 3), "step": done, "loss": loss})
        return f"stopped by the budget of {options.budget:g} s at step {done} of {options.steps}"

    def _begin_within(self, options: FitOptions, start: int) -> list[str]:
        """Let a network be at rest from the start where a budget is too short to try heights of its own; notes.

        To ask for its heights, and to read them off, can take longer than the whole budget.

        Args:
            options: of the fit.
            start: steps that an interrupted run has done, which has begun already.
        """
        if not options.budget or not self._may_rest or start:
            return []
        needed = self.trace.seconds() + 2 * self._foreseen_s
        if needed + self._judging_s <= BUDGET_SHARE * options.budget and needed <= self._room(options):
            return []
        self.trainer.asked = True
        self.trainer.rest(0)
        self.__dict__.pop("_reading_s", None)
        return [f"the budget of {options.budget:g} s has no room to try heights of its own"]

    @property
    def _may_rest(self) -> bool:
        trainer = self.trainer
        return trainer.judged and not trainer.asked and isinstance(trainer.field, MlpField)

    def _is_to_ask(self, number: int, options: FitOptions, step_s: float) -> bool:
        """Whether half of the training is over, after which a network that moved nothing may rest.

        With a budget it is over, too, where there is no room for another step as long as the last [s].
        """
        if not self._may_rest:
            return False
        if options.budget:
            now, room = self.trace.seconds(), self._room(options)
            if now >= room / 2 or now + step_s > room:
                return True
        return number >= self.trainer.steps / 2

    def _is_over(self, options: FitOptions, step_s: float) -> bool:
        """Whether the budget has no room for a step as long as the last [s]: one can take a minute."""
        if not options.budget or self.trace.seconds() + step_s <= self._room(options):
            return False
        # what reading off takes is known from a few rows: those of another time may have met a busy machine
        self._forget()
        return self.trace.seconds() + step_s > self._room(options)

    def _room(self, options: FitOptions) -> float:
        """Seconds of the budget for steps: the heights must still be judged, the surface be read off."""
        return BUDGET_SHARE * (options.budget or 0.0) - self._reading_s - self._judging_s

    def _forget(self) -> None:
        """Measure anew, when asked next, what reading off and judging take."""
        for name in ("_reading_s", "_prediction_s"):
            self.__dict__.pop(name, None)

    @functools.cached_property
    def _reading_s(self) -> float:
        """Seconds that reading the field off takes, by its first rows: read twice, as the first time compiles."""
        rows = min(max(ROWS_TRIED, rows_at_once(self.trainer, self.grid)), self.grid.height)
        for part in (1, rows):
            begun = time.perf_counter()
            read_maps(self.trainer, self.grid.part(slice(0, part), slice(0, self.grid.width)), self.z_range)
        return (time.perf_counter() - begun) * self.grid.height / rows

    @property
    def _judging_s(self) -> float:
        """Seconds that it takes to judge the heights, with the field's own and with those of the start."""
        judged = self.trainer.judged and not self.trainer.at_rest
        return self._prediction_s * 2 * RAYS / AT_ONCE if judged else 0.0

    @property
    def _foreseen_s(self) -> float:
        """Seconds of a step before one was taken: its way back takes twice as long as its prediction."""
        with self.trainer.multiplied():
            prediction_s = self._prediction_s if self.trainer.options.precision == "float32" else self._predicted_s()
        return prediction_s * 3 * self.trainer.count / AT_ONCE

    @functools.cached_property
    def _prediction_s(self) -> float:
        """Seconds of the prediction of `AT_ONCE` rays, in float32."""
        return self._predicted_s()

    def _predicted_s(self) -> float:
        begun = time.perf_counter()
        held_out_losses(self.trainer, torch.zeros(AT_ONCE, dtype=torch.long))
        return time.perf_counter() - begun

    def _first_loss(self) -> float:
        """Photometric loss before any step, by the first rays."""
        some = torch.arange(min(AT_ONCE, len(self.trainer.rays.target)))
        return float(held_out_losses(self.trainer, some).mean())

    def _plan_within(self, options: FitOptions, number: int, last: int, since: float) -> None:
        """Let rates and phases be shares of the steps that the budget has room for.

        Args:
            options: of the fit.
            number: steps that are done.
            last: steps by which it is told how long one takes, the last of these.
            since: when they began.
        """
        now = self.trace.seconds()
        step_s = (now - since) / last
        more = (self._room(options) - now) / max(step_s, 1e-6)
        self.trainer.plan(max(number + 1, min(options.steps, number + round(more))))

    def _score(self, reference: str | None) -> Row:
        if reference is None:
            return {}
        from sattools.compare import compare_dsm, read_reference

        pause = time.perf_counter()
        height = read_maps(self.trainer, self.grid, self.z_range, per_image=False).height
        error = float(compare_dsm(height.cpu().numpy(), read_reference(reference), self.grid).figures["mae"])
        self.trace.started += time.perf_counter() - pause  # watching must not count as fitting
        return {"mae_m": error}


__all__ = ["RayJob"]
