# SPDX-License-Identifier: Apache-2.0

"""One call of XLA, shared by the threads of XLA's pool.

A handler describes its call as a *job*: so many hypotheses, in parts of a few. It asks the pool to run a *task* that
works on the job, and runs the task itself. Each worker takes the next part that nobody has taken. Then the handler
waits for the parts that others have begun, and for nothing else: XLA promises neither that a task runs at once nor
that it runs at all. One that comes late finds no part. Hypotheses do not depend on each other, so results depend
neither on the number of threads nor on who worked on what.

A job is some 64-bit words in memory of its own, which the last one who leaves frees. Fields that several threads write
are changed by atomic operations.
"""

from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from bayes3d_ros.likelihood.cpu.call_frame import API_WORD, CONTEXT_WORD, SCHEDULE_WORD, THREADS_WORD
from bayes3d_ros.likelihood.cpu.compiling import allocating, strict
from bayes3d_ros.likelihood.cpu.xla_ffi import words

# Tuning of speed
PARTS_A_THREAD = 4  # some hypotheses take longer than others
LEAST_PART = 8  # hypotheses: to begin work, with working memory of its own, takes a worker as long as one or two

_TAKEN, _DONE, _PRESENT, _PARTS, _EACH, _COUNT, _FRAME = range(7)  # words of a job
_JOB_WORDS = 7
_WORD = ir.IntType(64)
_malloc = types.ExternalFunction("malloc", types.int64(types.int64))
_free = types.ExternalFunction("free", types.void(types.int64))
_sched_yield = types.ExternalFunction("sched_yield", types.int32())


@intrinsic
def _add(context, address, number):
    """Add to the word at an address, as one operation for all threads; returns what was there."""

    def generate(context, builder, signature, arguments):
        place = builder.inttoptr(arguments[0], _WORD.as_pointer())
        return builder.atomic_rmw("add", place, arguments[1], "seq_cst")

    return types.int64(types.int64, types.int64), generate


@intrinsic
def _call(context, function, arguments):
    """Call the function of XLA at an address with the address of its arguments; returns 0, or an error's address."""

    def generate(context, builder, signature, values):
        kind = ir.FunctionType(_WORD, [_WORD])
        return builder.call(builder.inttoptr(values[0], kind.as_pointer()), [values[1]])

    return types.int64(types.int64, types.int64), generate


@intrinsic
def _run(context, task, job):
    """Call the task at an address."""

    def generate(context, builder, signature, values):
        kind = ir.FunctionType(ir.VoidType(), [_WORD])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), [values[1]])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


def address_of(name: str, task: Any) -> Any:
    """A compiled function that returns the address of a compiled `task`. Compiled code that is kept on disk must not
    hold the address, which is another one in each process: it holds the name, which must be unique."""
    llvmlite.binding.add_symbol(name, task.address)

    @intrinsic
    def address(context):
        def generate(context, builder, signature, values):
            kind = ir.FunctionType(ir.VoidType(), [_WORD])
            return builder.ptrtoint(cgutils.get_or_insert_function(builder.module, kind, name), _WORD)

        return types.int64(), generate

    return address


@allocating
def _threads(frame):
    """How many threads the pool has; 1 where XLA does not say."""
    call, found = words(frame, CONTEXT_WORD + 1), np.ones(1, np.int64)
    arguments = np.array([32, 0, call[CONTEXT_WORD], found.ctypes.data], np.int64)
    error = _call(words(call[API_WORD], THREADS_WORD + 1)[THREADS_WORD], arguments.ctypes.data)
    return max(found[0], 1) if error == 0 else 1


@strict
def leave(job):
    if _add(job + 8 * _PRESENT, -1) == 1:
        _free(job)


@allocating
def share(frame, count, task):
    """Have `count` hypotheses of this call worked on by this thread and those of the pool. task: address of the
    function that takes parts of a job until none is left, and leaves it."""
    threads = _threads(frame) if count >= 2 * LEAST_PART else 1
    each = max(LEAST_PART, -(-count // (threads * PARTS_A_THREAD)))
    parts = -(-count // each)
    job = _malloc(8 * _JOB_WORDS)
    told = words(job, _JOB_WORDS)
    told[_TAKEN], told[_DONE], told[_PRESENT], told[_PARTS] = 0, 0, 2, parts  # present: the task here, and who waits
    told[_EACH], told[_COUNT], told[_FRAME] = each, count, frame
    call = words(frame, CONTEXT_WORD + 1)
    schedule = words(call[API_WORD], SCHEDULE_WORD + 1)[SCHEDULE_WORD]
    arguments = np.array([40, 0, call[CONTEXT_WORD], task, job], np.int64)
    for _ in range(min(threads, parts) - 1):
        _add(job + 8 * _PRESENT, 1)
        if _call(schedule, arguments.ctypes.data) != 0:
            _add(job + 8 * _PRESENT, -1)
            break
    _run(task, job)
    while _add(job + 8 * _DONE, 0) < parts:
        _sched_yield()
    leave(job)


@strict
def next_part(job):
    """The first hypothesis of a part that nobody has taken, and one past the last; the two are equal if there is
    none."""
    told = words(job, _JOB_WORDS)
    part = _add(job + 8 * _TAKEN, 1)
    if part >= told[_PARTS]:
        return 0, 0
    return part * told[_EACH], min((part + 1) * told[_EACH], told[_COUNT])


@strict
def part_done(job):
    _add(job + 8 * _DONE, 1)


@strict
def frame_of(job):
    """XLA's call frame, which lasts as long as there are parts to be done."""
    return words(job, _JOB_WORDS)[_FRAME]
