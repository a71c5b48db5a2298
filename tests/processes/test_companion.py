"""The thread beside the main thread: it works meanwhile, and its errors are those of the main thread."""

from __future__ import annotations

import os
import threading
import time

import pytest
from trirail.processes.companion import Companion


def no_answer() -> None:
    raise AssertionError("nobody has asked")


def test_work_runs_in_one_other_thread_while_the_body_runs() -> None:
    companion, began, threads = Companion(no_answer), threading.Event(), list[int]()

    def work() -> None:
        threads.append(threading.get_native_id())
        began.set()

    for _ in range(20):
        with companion.working(work):
            assert began.wait(10.0), "the work does not wait for the end of the body"
        began.clear()
    assert len(threads) == 20
    assert {*threads} == {threads[0]}
    assert threads[0] != threading.get_native_id()


def test_the_body_is_left_when_the_work_is_done() -> None:
    done = list[bool]()

    def work() -> None:
        time.sleep(0.05)
        done.append(True)

    with Companion(no_answer).working(work):
        assert not done
    assert done == [True]


def test_an_error_of_the_work_is_raised_and_the_thread_works_on() -> None:
    companion, done = Companion(no_answer), list[bool]()

    def fails() -> None:
        raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"), companion.working(fails):
        pass
    with companion.working(lambda: done.append(True)):
        pass
    assert done == [True]


def test_it_answers_each_ring_of_its_doorbell_and_an_error_is_raised_by_the_wait() -> None:
    answers = list[int]()

    def answer() -> None:
        answers.append(threading.get_native_id())
        if len(answers) == 2:
            raise ValueError("wrong")

    companion, worked = Companion(answer), list[bool]()
    companion.start()
    for number in range(1, 4):
        with companion.working(lambda: worked.append(True)):
            os.eventfd_write(companion.doorbell, 1)
        if number == 2:
            with pytest.raises(ValueError, match="wrong"):
                companion.wait()
        else:
            companion.wait()
        assert (len(answers), len(worked)) == (number, number)
    assert {*answers} == {answers[0]}
    assert answers[0] != threading.get_native_id()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may use SCHED_FIFO here")
def test_its_priority_is_one_lower() -> None:
    companion, seen = Companion(no_answer), list[tuple[int, int]]()

    def real_time() -> None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(3))
        with companion.working(lambda: seen.append((os.sched_getscheduler(0), os.sched_getparam(0).sched_priority))):
            pass

    thread = threading.Thread(target=real_time)  # the rights end with this thread
    thread.start()
    thread.join()
    assert seen == [(os.SCHED_FIFO, 2)]
