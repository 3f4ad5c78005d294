"""The page of a live scene: sliders and cameras of browsers become wishes, and a thread shows what they ask for."""

from __future__ import annotations

import hmac
import math
import secrets
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from http.cookies import SimpleCookie
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from full_geometry.settings import PATH_TRACED
from full_geometry.surface.textured import linear_of_srgb
from full_geometry.trade.image_differences import srgb
from full_geometry.transport.models import model_names
from full_geometry.viewing.edits import Camera, Edits, Way
from full_geometry.viewing.live import LiveScene, Screen, Wish
from halfspace_sss import materials
from halfspace_sss.backend import BackendError, needed
from halfspace_sss.checks import check_count
from halfspace_sss.physics.medium import Medium

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request

LOOPBACK = ("127.0.0.1", "localhost", "::1")
LIGHTS = {True: ("precomputed", "sampled"), False: ("gathered", "corrected", "sampled")}
AS_THEY_ARE, OWN, OF_SURFACES = "as in the scene", "by sliders", "of the surfaces"
PATIENCE = 1.0  # seconds; so often the file of the scene is looked at
PIXELS = 256**2
SIDE = 16  # sides of images are multiples of it


class Page:
    """A live scene served to browsers: edits are shared, cameras are not.

    Args:
        scene: as of `LiveScene`.
        host: address; one that is no loopback address asks for a token, which `url` has.
        port: 0 for any that is free.
        pixels: of an image, about.
        parameters: values of $NAME in the file.

    Raises:
        ValueError: the port is taken, or the scene is refused.
        BackendError: viser is not installed.
    """

    def __init__(
        self, scene: dict[str, Any] | str | Path, host: str = "127.0.0.1", port: int = 0, pixels: int = PIXELS,
        parameters: dict[str, str] | None = None,
    ) -> None:  # fmt: skip
        viser = needed("viser", "a page needs viser", "view")
        check_count("pixels", pixels, SIDE**2)
        self.live, self._pixels, self._source = LiveScene(scene, parameters), pixels, (scene, parameters)
        self.token = "" if host in LOOPBACK else secrets.token_urlsafe(16)
        port = port or free_port(host)
        check_port(host, port)
        with _guarded(self.token, f"halfspace_sss_{port}"):
            self.server = viser.ViserServer(host, port, label="halfspace-sss", verbose=False)
        self.server.request_share_url = lambda verbose=True: None  # no tunnel to the world
        shown = "localhost" if host in LOOPBACK else socket.gethostname() if host in ("0.0.0.0", "::") else host
        self.url = f"http://{shown}:{self.server.get_port()}/" + (f"?token={self.token}" if self.token else "")
        self._woken, self._stopped = threading.Event(), False
        self._controls = Controls(self.server.gui, self.live, self._wake, self._saved)
        self._screens: dict[int, tuple[Any, Screen, Any]] = {}
        self._look()
        self.server.on_client_connect(self._joined)
        self.server.on_client_disconnect(self._left)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and the server; a pass that is under way ends first."""
        self._wake(stopped=True)
        self._thread.join()
        self.server.stop()

    def check(self) -> None:
        """BackendError if the thread has ended, by an error that it has shown."""
        if not self._thread.is_alive():
            raise BackendError("the page shows no more images, for the reason above")

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" width="100%" height="600"></iframe>'

    # ---- what browsers say, in threads of the server

    def _look(self) -> None:
        """Let new cameras stand where that of the scene does."""
        pose, fov = np.array(self.live.camera(self._pixels).to_world), self.live.camera(self._pixels).fov
        distance = float(np.linalg.norm(self.live.centre - pose[:3, 3]))
        self.server.scene.set_up_direction(tuple(self.live.up.tolist()))
        self.server.initial_camera.position = tuple(pose[:3, 3].tolist())
        self.server.initial_camera.look_at = tuple((pose[:3, 3] + distance * pose[:3, 2]).tolist())
        self.server.initial_camera.up, self.server.initial_camera.fov = tuple(self.live.up.tolist()), math.radians(fov)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)

    def _joined(self, client: viser.ClientHandle) -> None:
        told = client.gui.add_markdown("making light ready …", order=-1)
        self._screens[client.client_id] = client, Screen(), told
        client.camera.on_update(lambda _: self._wake())
        self._wake()

    def _left(self, client: viser.ClientHandle) -> None:
        self._screens.pop(client.client_id, None)
        self._wake()

    def _wake(self, stopped: bool = False) -> None:
        self._stopped |= stopped
        self._woken.set()

    def _saved(self, name: str, client: viser.ClientHandle) -> str:
        wish = self._wish(client)
        return self.live.save(name, wish.way, wish.camera, wish.edits)

    def _wish(self, client: viser.ClientHandle) -> Wish:
        import viser.transforms as tf

        pose, camera = np.eye(4), client.camera
        pose[:3, :3] = tf.SO3(np.asarray(camera.wxyz)).as_matrix() @ np.diag([-1.0, -1.0, 1.0])
        pose[:3, 3] = camera.position
        aspect = float(np.clip(camera.image_width / max(camera.image_height, 1), 0.25, 4))
        height, width = (max(round(math.sqrt(self._pixels * f) / SIDE), 1) * SIDE for f in (1 / aspect, aspect))
        pose = tuple(map(tuple, np.round(pose, 7).tolist()))
        return self._controls.wish(Camera(pose, round(math.degrees(camera.fov), 4), width, height))

    # ---- images, in one thread of ours

    def _work(self) -> None:
        while not self._stopped:
            self._woken.clear()
            if self.live.stale():
                self._reload()
            if not any([self._serve(*each) for each in list(self._screens.values())]):
                self._woken.wait(PATIENCE)

    def _serve(self, client: viser.ClientHandle, screen: Screen, told: viser.GuiMarkdownHandle) -> bool:
        """Send one more image to a browser; whether there is more to come."""
        wish = self._wish(client)

        def outdated() -> bool:
            now = self._wish(client)
            return self._stopped or (now.edits, now.way) != (wish.edits, wish.way)

        result = screen.step(self.live, wish, outdated)
        if result is not None and not self._stopped and client.client_id in self._screens:
            image, told.content = result
            if image is not None:
                client.scene.set_background_image(image, format="jpeg", jpeg_quality=90)
        return result is not None or outdated()

    def _reload(self) -> None:
        """Take the file of the scene as it is now; one that is refused is waited for."""
        try:
            self.live = LiveScene(*self._source)
        except (ValueError, RuntimeError, OSError):
            return
        for _, screen, _ in list(self._screens.values()):
            screen.restart()


def view(scene: dict[str, Any] | str | Path, **options: object) -> Page:
    """Serve a scene to browsers, and in a notebook show it below the cell; `Page.close` ends it.
    `scene`: the path of an XML file, or a dict as for `mitsuba.load_dict`. `options`: as of `Page`."""
    return Page(scene, **options)


# ---- The controls of the page ---------------------------------------------------------------------------------------


class Controls:
    """Handles of viser by what they are for, of a live scene; they call `edited` and `saved`."""

    def __init__(
        self,
        gui: viser.GuiApi,
        live: LiveScene,
        edited: Callable[[], None],
        saved: Callable[[str, viser.ClientHandle], str],
    ) -> None:
        models = [*([] if live.way.model else [OF_SURFACES]), *(m for m in model_names() if m != "auto"), PATH_TRACED]
        walks = live.way.model == PATH_TRACED
        lights = tuple(dict.fromkeys((*LIGHTS[walks], live.way.light)))
        with gui.add_folder("Picture"):
            self.render: dict[str, Any] = {
                "model": gui.add_dropdown("model", models, initial_value=live.way.model or OF_SURFACES),
                "light": gui.add_dropdown("light", lights, initial_value=live.way.light),
                "denoise": gui.add_checkbox("denoised", False),
                "exposure": gui.add_slider("exposure, stops", -6.0, 6.0, 0.1, 0.0),
                "compare": gui.add_checkbox("reference beside", False),
                "split": gui.add_slider("split", 0.0, 1.0, 0.01, 0.5),
            }
        with gui.add_folder("Light"):
            self.light: dict[str, Any] = {
                "turn": gui.add_slider("turn, degrees", -180.0, 180.0, 1.0, 0.0),
                "tilt": gui.add_slider("tilt, degrees", -90.0, 90.0, 1.0, 0.0),
                "stops": gui.add_slider("brightness, stops", -5.0, 5.0, 0.1, 0.0),
                "environment": gui.add_dropdown("environment", [AS_THEY_ARE, *live.environments()]),
            }
        self.media: dict[str, MediumControls] = {}
        for name in live.names:
            with gui.add_folder(name):
                self.media[name] = MediumControls(gui, live.medium(name))
        with gui.add_folder("Save"):
            file = gui.add_text("file", f"{live.file.stem if live.file else 'scene'}_view.xml")
            said = gui.add_markdown("")

            @gui.add_button("save the scene").on_click
            def _(event: viser.GuiEvent) -> None:
                try:
                    said.content = f"`{saved(file.value, event.client)}`"
                except (ValueError, OSError) as error:
                    said.content = f"**{error}**"

        async def heard(event: viser.GuiEvent) -> None:
            if event.target is self.render["model"]:
                lights = LIGHTS[event.target.value == PATH_TRACED]
                self.render["light"].options = lights
                self.render["light"].value = lights[0]
            for medium in self.media.values() if event.client is not None else ():
                medium.heard(event.target)
            edited()

        handles = [self.light, self.render, *(medium.handles for medium in self.media.values())]
        for handle in [handle for each in handles for handle in each.values()]:
            handle.on_update(heard)

    def wish(self, camera: Camera) -> Wish:
        """What the controls ask for."""
        light = {name: handle.value for name, handle in self.light.items()}
        light["environment"] = "" if light["environment"] == AS_THEY_ARE else light["environment"]
        media = {name: said for name, medium in self.media.items() if (said := medium.said())}
        render = {name: handle.value for name, handle in self.render.items()}
        model = "" if render["model"] == OF_SURFACES else render["model"]
        way = Way(model, render["light"], render["denoise"])
        return Wish(Edits(**light, media=media), way, camera, render["exposure"], render["compare"], render["split"])


class MediumControls:
    """Controls of a medium, as it is; a slider moves the mean free paths (mm) of all channels together."""

    def __init__(self, gui: viser.GuiApi, medium: Medium) -> None:
        names = [AS_THEY_ARE, OWN, *materials.names()]
        self.handles: dict[str, Any] = {
            "material": gui.add_dropdown("material", names, initial_value=AS_THEY_ARE),
            "reflectance": gui.add_rgb("reflectance", (128, 128, 128)),
            "stops": gui.add_slider("mean free path, stops", -6.0, 6.0, 0.1, 0.0),
            "g": gui.add_slider("g", -0.9, 0.99, 0.01, 0.0),
            "eta": gui.add_slider("eta", 1.0, 2.0, 0.01, 1.3),
            "roughness": gui.add_slider("roughness", 0.0, 0.5, 0.01, 0.0),
        }
        self.show(medium)

    def show(self, medium: Medium) -> None:
        """Bring the sliders to a medium."""
        self.paths: np.ndarray = np.broadcast_to(1 / np.maximum(medium.sigma_t, 1e-9), 3)
        self.handles["reflectance"].value = tuple(
            np.round(255 * srgb(np.broadcast_to(np.maximum(medium.reflectance(), 0), 3))).astype(int).tolist()
        )
        self.handles["stops"].value, self.handles["eta"].value = 0.0, float(np.clip(medium.eta, 1.0, 2.0))
        self.handles["g"].value = float(np.clip(np.mean(medium.g), -0.9, 0.99))

    def heard(self, target: object) -> None:
        """After a browser has changed a control: sliders follow a material that is named, or stand for the medium."""
        name = self.handles["material"].value
        if target is self.handles["material"] and name not in (AS_THEY_ARE, OWN):
            self.show(materials.load(name).medium)
        elif any(target is self.handles[key] for key in ("reflectance", "stops", "g", "eta")):
            self.handles["material"].value = OWN

    def said(self) -> dict[str, Any]:
        """For `Edits`; empty for the medium of the scene."""
        said = {key: handle.value for key, handle in self.handles.items()}
        name, alpha = said["material"], {"roughness": said["roughness"]} if said["roughness"] else {}
        if name == AS_THEY_ARE and not alpha:
            return {}
        if name not in (AS_THEY_ARE, OWN):
            return {"material": name, **alpha}
        values = {
            "reflectance": tuple(linear_of_srgb(np.array(said["reflectance"]) / 255).tolist()),
            "mfp": tuple((2 ** said["stops"] * self.paths).tolist()),
        }
        return {**values, "g": said["g"], "eta": said["eta"], **alpha}


# ---- Ports, and who may connect -------------------------------------------------------------------------------------


def free_port(host: str) -> int:
    """A port that nobody listens to."""
    with socket.create_server((host, 0)) as found:
        return found.getsockname()[1]


def check_port(host: str, port: int) -> None:
    """ValueError if a port is taken, or the address is none of this machine."""
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise ValueError(f"port must be free at {host}, got {port}: {error.strerror or error}") from error


@contextmanager
def _guarded(token: str, cookie: str) -> Iterator[None]:
    """Servers of websockets that are made within refuse whom `refusal` refuses."""
    import websockets.asyncio.server as servers
    from websockets.http11 import Response

    serve = servers.serve

    def guarded(handler: Callable, *args: object, process_request: Callable, **more: object) -> Any:
        def asked(connection: ServerConnection, request: Request) -> Any:
            status, headers = refusal(request.path, request.headers, token, cookie)
            if status is None:
                return process_request(connection, request)
            return Response(status.value, status.phrase, type(request.headers)(headers), b"")

        return serve(handler, *args, process_request=asked, **more)

    servers.serve = guarded
    try:
        yield
    finally:
        servers.serve = serve


def refusal(path: str, headers: Mapping[str, str], token: str, cookie: str) -> tuple[HTTPStatus | None, dict[str, str]]:
    """The status with which a request is answered instead of the page, and headers; None where it may pass.
    Pages of others may not connect: their origin is another, or the name they found us by is. With a token its address
    sets a cookie, and nobody passes without that."""
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return HTTPStatus.FORBIDDEN, {}
    if not token:
        return (None if urlsplit(f"//{host}").hostname in LOOPBACK else HTTPStatus.FORBIDDEN), {}
    given = parse_qs(urlsplit(path).query).get("token", [""])[0]
    if hmac.compare_digest(given.encode(), token.encode()):
        return HTTPStatus.FOUND, {"Location": "/", "Set-Cookie": f"{cookie}={token}; HttpOnly; SameSite=Strict"}
    known = SimpleCookie(headers.get("Cookie", "")).get(cookie)
    passes = known is not None and hmac.compare_digest(known.value.encode(), token.encode())
    return (None if passes else HTTPStatus.UNAUTHORIZED), {}
