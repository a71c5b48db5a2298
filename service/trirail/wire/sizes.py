"""How large anything may be that comes from outside or goes between the processes: one fact for every way it takes."""

MAX_POINTS = 400
"""Points of a trajectory. With velocities and accelerations they are 50 kB of msgpack, 98 kB of JSON or more."""
MAX_PACKET = 65_536
"""A packet between the processes: the largest goal, as msgpack, and what stands around it [bytes]."""
MAX_MESSAGE = 262_144
"""A goal or command: the largest goal as JSON, indented and with all its digits. What is longer is refused before it is
decoded [bytes]."""
MAX_TRANSPORT = 4_194_304
"""What the transport puts together of fragments, for each client and priority: this bounds its memory. Up to that a
message that is too large is answered; what is larger it throws away, and who asked waits until its time-out [bytes]."""
MAX_UNREAD = 16_777_216
"""Messages that may wait in the gateway to be read, all together; beyond that they are refused [bytes]."""
MAX_NAME = 64
"""A robot's or user's name, or a goal's id [characters]."""
MAX_TEXT = 512
"""What a reply or an event quotes of a message that was refused [characters]."""
