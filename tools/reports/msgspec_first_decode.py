"""msgspec 0.22.0 on CPython 3.11.7, with the GIL: SIGSEGV if two threads decode a type for the first time.

    python msgspec_first_decode.py [children]

prints with which statuses the children (400 by default) have ended, with and without the workaround. The cause:
StructInfo_Convert (_core.c) stores a new StructInfo in the class (`class->struct_info = info`) and fills `types[]`
afterwards. To do so, TypeNode_Convert runs Python code (annotations, enums, unions), during which the GIL may pass to a
second thread. This thread finds the StructInfo, assumes that it is complete, and reads `types[i] == NULL`, for example
in json_decode_struct_map_inner. On free-threaded builds, a critical section and `initialized` prevent this. The
workaround is to create a decoder before there is a second thread.

According to the source code, msgspec.convert, msgpack, dataclasses, TypedDicts and NamedTuples have the same problem.
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
    """Return the number of children that ended with each status. The status of a signal is a negative number."""
    statuses: Counter[int] = Counter()
    for _ in range(children):
        child = os.fork()
        if child == 0:
            sys.setswitchinterval(1e-5)  # makes the error frequent; without this, it is rare
            decode_in_two_threads(prepared)
            os._exit(0)
        statuses[os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])] += 1
    return statuses


if __name__ == "__main__":
    how_many = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    print("msgspec", msgspec.__version__, "on Python", sys.version)
    print("first decoded in two threads:", dict(ended(how_many, prepared=False)))
    print("decoder made before:         ", dict(ended(how_many, prepared=True)))
