"""BLAS on one thread while a computation asks for it, from whichever thread it comes."""

import threading

from estune.support.blas import _controller, one_blas_thread


def threads() -> set[int]:
    return {library["num_threads"] for library in _controller().info()}


def threads_inside() -> set[int]:
    with one_blas_thread():
        return threads()


def test_one_blas_thread_holds_in_a_thread_beside_one_that_held_it_before():
    with _controller().limit(limits=2, user_api="blas"):
        assert threads() == {2}
        found, ended = [threads_inside()], threading.Event()
        earlier = threading.Thread(target=lambda: (found.append(threads_inside()), ended.wait()))
        earlier.start()
        later = threading.Thread(target=lambda: found.append(threads_inside()))
        later.start()
        later.join()
        ended.set()
        earlier.join()
        assert found == [{1}] * 3
        assert threads() == {2}
