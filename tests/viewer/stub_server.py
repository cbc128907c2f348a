"""Made-up sessions over the viewer's socket, to look at the page without a bus: no zenoh, no simulator, no estimator.

python -m tests.viewer.stub_server --port 8123

http://127.0.0.1:8123/planning/ is the scene of that name; there are: tracking, planning, blocked, exploring, ambiguous,
lost, no-estimator, empty, watch-only, mapped (a ROS map), floors (a building). Without a name it is `tracking`.
"""

from __future__ import annotations

import argparse
import asyncio
import json
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.routing import Mount, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.world import World, load_world
from common.robot.robot import Robot
from tests.common.geometry.maps import building, rooms
from tests.viewer.stub_session import DT, SCANNER, SCENES, WORLDS, Session, services_message

STATIC = Path(__file__).resolve().parents[2] / "services" / "viewer" / "static"

MAPPED = World(name="rooms", grid=OccupancyGrid.of(rooms(260), 0.05, (2.0, -1.0, 0.3)))


def tower() -> World:
    """A building of two floors with a lift."""
    lifts = [{"ground": (17.0, 1.0), "first": (3.0, 2.0)}]
    return building(lifts, ground=load_world("corridor"), first=load_world("office"))


MADE = {"mapped": lambda: MAPPED, "floors": tower}  # the other worlds are shipped


class Visitor:
    """A connected page."""

    def __init__(self, socket: WebSocket, session: Session) -> None:
        """Visitors of a scene share its session."""
        self.socket, self.session = socket, session
        self.field: bytes | None = None  # the last one sent

    async def send(self, **message: object) -> None:
        """Sends a message as JSON."""
        await self.socket.send_text(json.dumps(message))

    async def world(self) -> None:
        """Sends world, scanner and robot."""
        world = self.session.world.model_dump(mode="json")
        await self.send(
            type="world", world=world, scanner=SCANNER.model_dump(mode="json"), robot=Robot().model_dump(mode="json")
        )

    async def feed(self) -> None:
        """Sends frames and services until the visitor leaves."""
        session, count = self.session, 0
        live = session.scene != "empty"
        await self.send(
            type="hello", control=session.scene != "watch-only", version="stub", robots=["robot"] * live, robot="robot"
        )
        if live:
            await self.world()
            columns = zip(*session.history, strict=True) if session.history else [[]] * 6
            names = ("t", "free_energy", "accuracy", "complexity", "error", "speed")
            await self.send(type="history", samples={n: list(c) for n, c in zip(names, columns, strict=True)})
            await self.send(**session.journal())
        while True:
            if live and not session.paused:
                await self.socket.send_bytes(session.step())
                if session.planner is not None and session.planner.news is not self.field:
                    self.field = session.planner.news
                    await self.socket.send_bytes(self.field)
            if count % 15 == 0:
                await self.send(**services_message(session.scene))
            count += 1
            await asyncio.sleep(DT)

    async def listen(self) -> None:
        """Answers requests until the visitor leaves."""
        while True:
            request = json.loads(await self.socket.receive_text())
            await self.send(type="answer", id=request.get("id"), **self.session.act(request))
            if request.get("do") == "obstacle":
                await self.world()


def application(warm: float) -> Starlette:
    """The page and its socket for each scene, with a history of ``warm`` s."""
    sessions: dict[str, Session] = {}

    def session_of(scene: str) -> Session:
        if scene not in sessions:
            world = MADE[scene]() if scene in MADE else load_world(WORLDS.get(scene, "corridor"))
            sessions[scene] = Session(world, scene)
            for _ in range(int(warm / DT)):
                sessions[scene].step()
        return sessions[scene]

    async def socket(websocket: WebSocket) -> None:
        await websocket.accept()
        visitor = Visitor(websocket, session_of(websocket.path_params.get("scene", "tracking")))
        feeding = asyncio.create_task(visitor.feed())
        try:
            await visitor.listen()
        except WebSocketDisconnect:
            pass
        finally:
            feeding.cancel()

    page = StaticFiles(directory=STATIC, html=True)
    scenes = [Mount(f"/{scene}", page) for scene in SCENES]
    return Starlette(
        routes=[WebSocketRoute("/ws", socket), WebSocketRoute("/{scene}/ws", socket), *scenes, Mount("/", page)]
    )


def main() -> None:
    """Runs the server."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, default=8123)
    parser.add_argument("--warm", type=float, default=0.0, help="duration of the history at the start, s")
    args = parser.parse_args()
    uvicorn.run(application(args.warm), host="127.0.0.1", port=args.port, log_level="warning")


if __name__ == "__main__":
    main()
