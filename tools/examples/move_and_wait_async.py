"""A pose goal with asyncio, watched while it is under way: python move_and_wait_async.py [ROBOT [LOCATOR]]."""

import asyncio
import sys

from trirail import AsyncRobot, RefusedError


async def main() -> None:
    """Move, print the pose twice a second meanwhile, and say how it ended."""
    async with AsyncRobot(*sys.argv[1:]) as robot:
        await robot.enable()
        goal = await robot.move_to(x=-0.02, y=0.01, phi=-0.1, speed=0.1)
        watching = asyncio.create_task(watch(robot))
        result = await goal.wait(timeout=30)
        watching.cancel()
        print(result.outcome, result.message)


async def watch(robot: AsyncRobot) -> None:
    """Print where the robot is, until cancelled."""
    async for state in robot.states():
        print(f"x {state.pose[0]:.4f} m")
        await asyncio.sleep(0.5)  # the next one is the newest again


try:
    asyncio.run(main())
except RefusedError as error:
    sys.exit(f"refused ({error.code}): {error}")
