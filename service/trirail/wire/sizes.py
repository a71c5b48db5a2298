"""How large anything may be that comes from outside or goes between the processes: one fact for every way it takes."""

MAX_PART = 400
"""Points of a trajectory in one message. With velocities and accelerations they are 50 kB of msgpack, 98 kB of JSON or
more."""
MAX_POINTS = 5_000
"""Points of a trajectory, in as many messages as it takes: as JSON with all digits they fill MAX_UNREAD_OF_ONE, and the
planner needs 20 µs for each."""
MAX_FILE = 1_572_864
"""A file of points that the operator's page sends to its server: MAX_POINTS as JSON with all digits [bytes]."""
MAX_PACKET = 65_536
"""A packet between the processes; a larger one is passed as a file in memory [bytes]."""
MAX_SHARED = 4_194_304
"""Such a file: a goal of MAX_POINTS on top of two motions under way of as many [bytes]."""
MAX_MESSAGE = 262_144
"""A goal or command: the largest goal as JSON, indented and with all its digits. What is longer is refused before it is
decoded [bytes]."""
MAX_TRANSPORT = 4_194_304
"""What the transport puts together of fragments, for each client and priority: this bounds its memory. Up to that a
message that is too large is answered; what is larger it throws away, and who asked waits until its time-out [bytes]."""
MAX_BESIDE = 4096
"""Key, parameters and attachment of a query together, beside its payload [bytes]."""
MAX_UNREAD = 12_000_000
"""Memory that all messages in the gateway may hold until they are answered; beyond that they are refused [bytes]."""
MAX_UNREAD_OF_ONE = MAX_UNREAD // 4
"""The same of one user's messages [bytes]."""
MAX_REFUSED = 8_388_608
"""Memory that messages may hold whose refusal is still to be sent: two of the largest [bytes]."""
MAX_NAME = 64
"""A robot's or user's name, or a goal's id [characters]."""
MAX_TEXT = 512
"""What a reply or an event quotes of a message that was refused [characters]."""
