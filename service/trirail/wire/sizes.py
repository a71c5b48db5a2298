"""Maximum sizes of messages from outside and of packets between the processes."""

MAX_PART = 400
"""Points of a trajectory in one message. With velocities and accelerations they take 50 kB as msgpack, and 98 kB or
more as JSON."""
MAX_POINTS = 5_000
"""Points of a trajectory in all its messages: as JSON with all digits they fill MAX_UNREAD_OF_ONE, and the planner
needs 20 µs for each."""
MAX_FILE = 1_572_864
"""File of points that the operator's page sends to its server: MAX_POINTS as JSON with all digits [bytes]."""
MAX_PACKET = 65_536
"""Packet between the processes; a larger one is passed as a file in memory [bytes]."""
MAX_SHARED = 4_194_304
"""Size of such a file: a goal of MAX_POINTS in addition to two present motions of that length [bytes]."""
MAX_MESSAGE = 262_144
"""Goal or command: the largest goal as JSON, indented and with all digits. A longer message is refused before it is
decoded [bytes]."""
MAX_TRANSPORT = 4_194_304
"""Message that the transport reassembles from fragments, for each client and priority, which bounds its memory. Up to
this size a message that is too large gets a refusal; a larger one is dropped, and its sender waits until its time-out
[bytes]."""
MAX_BESIDE = 4096
"""Key, parameters and attachment of a query together, without its payload [bytes]."""
MAX_UNREAD = 12_000_000
"""Memory of all unanswered messages in the gateway; more are refused [bytes]."""
MAX_UNREAD_OF_ONE = MAX_UNREAD // 4
"""Memory of one user's unanswered messages [bytes]."""
MAX_REFUSED = 8_388_608
"""Memory of messages whose refusal has not been sent yet: two of the largest [bytes]."""
MAX_NAME = 64
"""Name of a robot or user, or id of a goal [characters]."""
MAX_TEXT = 512
"""Part of a refused message that a reply or an event quotes [characters]."""
