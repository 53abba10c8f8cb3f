"""Nodes of an implementation of rmw_zenoh's protocol that is not ours (PyPI, pyzeros): its keys, tokens and types.

stranger.py serve   services /plan and /secret, topics /pose and /secret_pose all the time
stranger.py look    print which of these answer or are heard
"""

import asyncio
import contextlib
import json
import sys

import asyncio_for_robotics as afor
import pyzeros
from over_zenoh import session
from pyzeros.sub import RawSub
from ros2_pyterfaces.cyclone.all_msgs import String
from ros2_pyterfaces.cyclone.all_srvs import Trigger

PATIENCE_S = 3.0


@afor.scoped
async def serve() -> None:
    async def answer(name: str) -> None:
        async for call in pyzeros.Server(Trigger, name).listen_reliable():
            call.response.success = True
            call.send()

    async def say(name: str) -> None:
        publisher = pyzeros.Pub(String, name)
        while True:
            publisher.publish(String(data=name))
            await asyncio.sleep(0.1)

    print("up", flush=True)
    await asyncio.gather(*map(answer, ("/plan", "/secret")), *map(say, ("/pose", "/secret_pose")))


@afor.scoped
async def look() -> None:
    found: set[str] = set()

    async def ask(name: str) -> None:
        with contextlib.suppress(TimeoutError):
            said = await asyncio.wait_for(pyzeros.Client(Trigger, name).call_async(Trigger.Request()), PATIENCE_S)
            found.update([name] if said.success else [])

    kept = [RawSub(String, name, lambda _, name=name: found.add(name)) for name in ("/pose", "/secret_pose")]
    await asyncio.gather(*map(ask, ("/plan", "/secret")), asyncio.sleep(PATIENCE_S))
    print(json.dumps(sorted(found)), flush=True)
    kept.clear()


if __name__ == "__main__":
    with pyzeros.auto_context(node=sys.argv[1], zenoh_session=session(), domain_id=0):
        asyncio.run(globals()[sys.argv[1]]())
