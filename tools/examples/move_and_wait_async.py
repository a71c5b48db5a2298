"""Move to a pose with asyncio, and watch the robot meanwhile: python move_and_wait_async.py [ROBOT [LOCATOR]]."""

import asyncio
import sys

from trirail import AsyncRobot, RefusedError


async def main() -> None:
    """Move, print the position twice a second during the motion, and print the outcome."""
    async with AsyncRobot(*sys.argv[1:]) as robot:
        await robot.enable()
        goal = await robot.move_to(x=-0.02, y=0.01, phi=-0.1, speed=0.1)
        watching = asyncio.create_task(watch(robot))
        result = await goal.wait(timeout=30)
        watching.cancel()
        print(result.outcome, result.message)


async def watch(robot: AsyncRobot) -> None:
    """Print the position of the robot until this task is cancelled."""
    async for state in robot.states():
        print(f"x {state.pose[0]:.4f} m")
        await asyncio.sleep(0.5)  # the loop then continues with the newest state


try:
    asyncio.run(main())
except RefusedError as error:
    sys.exit(f"refused ({error.code}): {error}")
