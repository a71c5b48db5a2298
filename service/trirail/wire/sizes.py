"""Maximum sizes of messages from outside and of packets between the processes."""

MAX_PART = 400
"""Maximum number of points of a trajectory in one message.

With velocities and accelerations, this many points take 50 kB as msgpack, and 98 kB or more as JSON."""
MAX_POINTS = 5_000
"""Maximum number of points of a trajectory in all of its messages.

As JSON with all digits, this many points fill MAX_UNREAD_OF_ONE. The planner needs 20 µs for each point."""
MAX_FILE = 1_572_864
"""Maximum size of a trajectory file that the operator's web page sends to its server [bytes].

MAX_POINTS points as JSON with all digits fit into the file."""
MAX_PACKET = 65_536
"""Maximum size of a packet between the processes [bytes]; a larger packet is passed as a file in memory."""
MAX_SHARED = 4_194_304
"""Maximum size of a packet that is passed as a file in memory [bytes].

A goal of MAX_POINTS points and two present motions of the same length fit into the packet."""
MAX_MESSAGE = 262_144
"""Maximum size of a goal or command [bytes]; a larger message is refused before it is decoded.

The largest goal fits as indented JSON with all digits."""
MAX_TRANSPORT = 4_194_304
"""Maximum size of a message that Zenoh's transport reassembles from fragments, for each client and priority [bytes].

This size limits the transport's memory. A message between MAX_MESSAGE and MAX_TRANSPORT is refused with a reply. A
larger message is dropped, and its sender waits until its time-out."""
MAX_BESIDE = 4096
"""Maximum size of the key, the parameters and the attachment of a query together, without the payload [bytes]."""
MAX_UNREAD = 12_000_000
"""Maximum memory for all unanswered messages in the gateway [bytes]; further messages are refused."""
MAX_UNREAD_OF_ONE = MAX_UNREAD // 4
"""Maximum memory for the unanswered messages of one user [bytes]; further messages are refused."""
MAX_REFUSED = 8_388_608
"""Maximum memory for refused messages until their refusals have been sent, the size of two largest messages [bytes]."""
MAX_NAME = 64
"""Maximum length of the name of a robot or user, or of the id of a goal [characters]."""
MAX_TEXT = 512
"""Maximum length of the text that a reply or an event quotes from a refused message [characters]."""
