"""Maximum sizes of messages from outside and of packets between the processes."""

MAX_PART = 400
"""Points of a trajectory in one message. With velocities and accelerations they take 50 kB as msgpack, and 98 kB or
more as JSON."""
MAX_POINTS = 5_000
"""Points of a trajectory in all its messages: as JSON with all digits they fill MAX_UNREAD_OF_ONE, and the planner
needs 20 µs for each."""
MAX_FILE = 1_572_864
"""Size of a file of points that the operator's page sends to its server; MAX_POINTS fit as JSON with all digits
[bytes]."""
MAX_PACKET = 65_536
"""Size of a packet between the processes; a larger one is passed as a file in memory [bytes]."""
MAX_SHARED = 4_194_304
"""Size of such a file; it holds a goal of MAX_POINTS and two present motions of the same length [bytes]."""
MAX_MESSAGE = 262_144
"""Size of a goal or command; the largest goal fits as indented JSON with all digits. A larger message is refused before
it is decoded [bytes]."""
MAX_TRANSPORT = 4_194_304
"""Size of a message that the transport reassembles from fragments, for each client and priority; it bounds the
transport's memory. A message up to this size is refused if it is too large. A larger message is dropped, and its sender
waits until its time-out [bytes]."""
MAX_BESIDE = 4096
"""Size of a query's key, parameters and attachment together, without its payload [bytes]."""
MAX_UNREAD = 12_000_000
"""Memory of all unanswered messages in the gateway; further messages are refused [bytes]."""
MAX_UNREAD_OF_ONE = MAX_UNREAD // 4
"""Memory of one user's unanswered messages; further messages are refused [bytes]."""
MAX_REFUSED = 8_388_608
"""Memory of messages whose refusal has not been sent yet: two of the largest [bytes]."""
MAX_NAME = 64
"""Length of a robot's or user's name, or of a goal's id [characters]."""
MAX_TEXT = 512
"""Length of the text that a reply or an event quotes from a refused message [characters]."""
