"""Controlled stop before the expiry of the robot's certificate, after which no client can reach the robot."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Final

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.credentials import Credentials
from trirail.wire.event_codes import EventCode, coded
from trirail.wire.messages import Notice

STOP_BEFORE: Final = timedelta(seconds=10)
"""Time before the expiry at which the robot stops, so that clients still see the reason."""
_REMEDY = "renew it with trirail keys renew, then restart the service"


class CertificateExpiry:
    """Watch on the expiry of the robot's certificate.

    Zenoh and the stop port end all connections when the certificate expires, so that nobody could stop the robot.

    Parameters
    ----------
    credentials
        Credentials of the robot; None for a service without certificates.
    stop
        Function that stops the robot. It returns False if it must be called again.
    announce
        Function that announces a notice. It returns False if it must be called again.

    """

    def __init__(
        self,
        credentials: Credentials | None,
        stop: Callable[[], bool],
        announce: Callable[[Notice], bool],
        clock: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._credentials, self._stop, self._announce, self._clock = credentials, stop, announce, clock
        self._announced = self._stopped = False

    @property
    def is_near(self) -> bool:
        """Whether the certificate has expired or expires within STOP_BEFORE."""
        return self._credentials is not None and self._credentials.expires - self._clock() <= STOP_BEFORE

    def poll(self) -> None:
        """Announce the expiry and stop the robot, once, if the expiry is near."""
        if self._credentials is None or not self.is_near:
            self._announced = self._stopped = False  # also if the machine's clock was set back
            return
        if not self._announced:
            words = (
                f"certificate in {self._credentials.folder}: expires at {self._credentials.expires:%Y-%m-%d %H:%M:%S} "
                f"UTC, and no client can reach the robot after that: controlled stop; {_REMEDY}"
            )
            text = coded(words, EventCode.CERTIFICATE_EXPIRES)
            self._announced = self._announce(Notice("service", "error", text.text, **text.fields))
        self._stopped = self._stopped or self._stop()

    def check(self, request: str) -> None:
        """Raise RefusedError if a request, such as "a goal", would move a robot that nobody can reach soon."""
        if self.is_near:
            problem = f"the robot's certificate expires: nobody could stop the robot after {request}; {_REMEDY}"
            raise RefusedError(RefusalCode.ENDED, problem)
