"""All services of `presage up`, for tests of the page."""

from __future__ import annotations

from tests.viewer.client import page_of

SEEN = """(() => {
    window.seen = [];
    const take = store.takeFrame.bind(store);
    store.takeFrame = (frame, now) => {
        const { belief, truth } = frame;
        window.seen.push([frame.t, now, belief && truth ? Math.hypot(belief.x - truth.x, belief.y - truth.y) : -1]);
        take(frame, now);
    };
})()"""  # from now on: stamp in s, arrival in ms, distance in m between drawn belief and truth


class System:
    """Everything that `presage up` starts."""

    def __init__(self, processes, pace="realtime"):
        self.processes = processes
        _, port = self.processes.start_router()
        self.environment = {"PRESAGE_CONNECT": f"tcp/127.0.0.1:{port}", "PRESAGE_ROBOT": "robot"}
        self.folder, self.running = processes.folder / "recordings", {}
        self.folder.mkdir()
        self.start("simulator", "--pace", pace)
        for name in ("estimator", "controller"):
            self.start(name)
        self.start("recorder", "--idle", "--directory", str(self.folder))
        self.address = page_of(self.start("viewer", "--port", "0", "--recordings", str(self.folder)))

    def start(self, name, *args):
        self.running[name] = self.processes.start(name, *args, env=self.environment)
        return self.running[name]
