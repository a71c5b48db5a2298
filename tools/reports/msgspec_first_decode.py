"""msgspec 0.22.0 on CPython 3.11.7, with the GIL: two threads that decode a type for the first time, and SIGSEGV.

    python msgspec_first_decode.py [children]

prints how many children of that many (400) a signal has ended, for each way to begin. StructInfo_Convert (_core.c)
puts a new StructInfo on the class (`class->struct_info = info`) and fills `types[]` afterwards. TypeNode_Convert runs
Python for that (annotations, enums, unions), where the GIL may change hands: a second thread finds the StructInfo,
takes it for complete and reads `types[i] == NULL`, in json_decode_struct_map_inner for one. On free-threaded builds a
critical section and `initialized` prevent it. A decoder that is made before there is a second thread is a way round.

The same holds, as the code reads, for msgspec.convert, msgpack, dataclasses, TypedDicts and NamedTuples.
"""

import os
import sys
import threading
from collections import Counter

import msgspec

FIELDS = {f"field_{n}": float | None for n in range(20)}


def decode_in_two_threads(prepared: bool) -> None:
    """Decode a new type in two threads at the same time."""
    kind = msgspec.defstruct("Inner", FIELDS.items())
    outer = msgspec.defstruct("Outer", [("first", str), ("inner", kind)])
    content = msgspec.json.encode({"first": "", "inner": dict.fromkeys(reversed(FIELDS), 1.0)})
    if prepared:
        msgspec.json.Decoder(outer)
    begin = threading.Barrier(2)

    def decode() -> None:
        begin.wait()
        msgspec.json.decode(content, type=outer)

    threads = [threading.Thread(target=decode) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def ended(children: int, prepared: bool) -> Counter[int]:
    """Return how many children ended with each status, a signal's as a negative number."""
    statuses: Counter[int] = Counter()
    for _ in range(children):
        child = os.fork()
        if child == 0:
            sys.setswitchinterval(1e-5)  # it happens without, too: now and then
            decode_in_two_threads(prepared)
            os._exit(0)
        statuses[os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])] += 1
    return statuses


if __name__ == "__main__":
    how_many = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    print("msgspec", msgspec.__version__, "on Python", sys.version)
    print("first decoded in two threads:", dict(ended(how_many, prepared=False)))
    print("decoder made before:         ", dict(ended(how_many, prepared=True)))
