"""Send a goal with only Zenoh and JSON, as in any language, and await its end: python plain_zenoh.py [ROBOT [LOCATOR]].

The schemas in trirail/wire/schemas describe the messages.
"""

import json
import queue
import sys

import zenoh

robot, locator = (*sys.argv[1:], *("demo", "tcp/127.0.0.1:7447")[len(sys.argv) - 1 :])
settings = zenoh.Config()
settings.insert_json5("mode", '"client"')
settings.insert_json5("connect/endpoints", json.dumps([locator]))


def ask(key: str, content: object = None) -> dict[str, object]:
    """Query the service. The answer arrives when a goal has been accepted, or a command carried out."""
    payload = None if content is None else json.dumps(content)
    for reply in session.get(f"trirail/{robot}/{key}", payload=payload, timeout=20.0):
        if reply.ok is not None:
            return dict(json.loads(reply.ok.payload.to_string()))
        sys.exit(f"refused: {reply.err.payload.to_string() if reply.err else ''}")
    sys.exit(f"no robot {robot} answers at {locator}")


with zenoh.open(settings) as session:
    events: queue.Queue[dict[str, object]] = queue.Queue()
    heard = session.declare_subscriber(
        f"trirail/{robot}/event", lambda sample: events.put(json.loads(sample.payload.to_string()))
    )
    print(ask("cmd/plain/enable"))
    goal = ask("goal/plain", {"kind": "pose", "x": 0.0, "y": 0.02, "phi": -0.1})
    print(goal)
    while (event := events.get(timeout=30.0)).get("id") != goal["id"]:  # one event reports the end of each goal
        pass
    print(event["outcome"], event["message"])
