# SPDX-License-Identifier: Apache-2.0
"""Train a matcher before the first query: once for each training set, in its own process, kept as a text."""

from collections.abc import Callable
from functools import partial

from sasgeo_bench.files.folders import locked
from sasgeo_bench.matching.learned_file import read_learned, write_learned
from sasgeo_bench.progress import tell
from sasgeo_bench.running.failures import LOG, guard, our_failure
from sasgeo_bench.running.plan import RunPlan, TrainingResult, reach_of, with_training_result
from sasgeo_bench.running.replies import PluginReply, Reply
from sasgeo_bench.running.training_tasks import TrainingSet, read_pairs
from sasgeo_bench.running.worker import Worker
from sasgeo_bench.texts import one_line


def trained(plan: RunPlan) -> RunPlan:
    """Train a matcher, if there is a training set, a pending query, and no earlier result. Tell its outcome.

    After a failed training, every query gets its cause for an answer.

    Raises
    ------
    StoreError
        If a task was made anew meanwhile, or the learned text cannot be stored.
    """
    given, path = plan.training_set, plan.learned_file
    is_pending = plan.training_result is None and any(part.left for part in plan.parts)
    if given is None or path is None or not is_pending:
        return plan
    with locked(path):
        text = read_learned(path)
        if text is None:
            reply = _learn(plan, given)
            if reply.status != "ok" or reply.learned is None:
                failed = failed_training(reply)
                tell(f"{plan.card.name}: {failed.message} ({failed.status}), learning from {given.to_text()}")
                return with_training_result(plan, failed)
            write_learned(path, reply.learned)
            text = reply.learned
            tell(f"{plan.card.name}: trained on {given.to_text()} in {reply.seconds or 0.0:.1f} s, {path}")
    return with_training_result(plan, TrainingResult(text=text))


def _learn(plan: RunPlan, training_set: TrainingSet) -> Reply:
    """Train in a process of its own, which may read the maps and is sent the truths."""
    request, regions = plan.request, training_set.regions
    pairs = read_pairs(training_set)
    reach = reach_of(request, tuple(regions.values()))
    with Worker(spec=request.spec, reach=reach, limits=request.limits) as worker:
        return guarded(plan, partial(worker.learn, regions, pairs))


def guarded(plan: RunPlan, ask: Callable[[], Reply]) -> Reply:
    """Return the reply to a question; an error counts as one, unless our own disk or folders are at fault."""
    return guard(ask, partial(failed_by_us, plan))


def failed_by_us(plan: RunPlan, error: Exception) -> Reply:
    """Log the traceback of an error of our own code, and return the reply to its query."""
    return Reply(status="crash", message=our_failure(plan.run_folder / LOG, plan.card.name, error))


def failed_training(reply: PluginReply) -> TrainingResult:
    """Return the result of a failed training, whose message all rows get."""
    if reply.status == "ok":
        return TrainingResult(status="invalid", message="while learning: no text in an answer")
    return TrainingResult(status=reply.status, message=one_line(f"while learning: {reply.message}"))
