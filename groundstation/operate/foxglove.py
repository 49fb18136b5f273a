"""A vehicle for viewers that speak Foxglove's WebSocket protocol (Foxglove, Lichtblick, PlotJuggler): no ROS anywhere.

The messages are those of `operate.ros2`, byte for byte, each topic with the definition of its type in ROS' own words.
"""

from __future__ import annotations

from typing import Any

from trueflight.groundstation.operate.ros2 import MAP, Messages, ros_name, topics_of
from trueflight.models.errors import InputError

PORT = 8765
"""Where viewers look unless told otherwise."""


class FoxgloveServer:
    """A server with a channel for each topic of a vehicle; viewers may look, and send nothing.

    Raises `InputError` where foxglove-sdk is not installed, or nothing can listen at `host` and `port`; port 0 is any
    that is free. Use as a context manager.
    """

    def __init__(self, vehicle: str, messages: Messages, host: str = "127.0.0.1", port: int = PORT) -> None:
        foxglove = _sdk()
        context = self._context = foxglove.Context()  # with it the channels would go
        try:
            self._server = foxglove.start_server(
                name=f"trueflight: {vehicle}",
                host=host,
                port=port,
                context=context,
                supported_encodings=["cdr"],
            )
        except RuntimeError as error:
            said = str(error).removeprefix("FoxgloveError: ")
            raise InputError(
                f"{host}:{port}: no viewer can be served there ({said}); choose another --port, or --host"
            ) from None
        self.port: int = self._server.port
        self.sent = 0
        self._channels: dict[str, Any] = {}
        for name, topic in topics_of(vehicle).items():
            schema = foxglove.Schema(
                name=topic.kind, encoding="ros2msg", data=messages.definition(topic.kind).encode()
            )
            self._channels[name] = foxglove.Channel(
                topic.name, schema=schema, message_encoding="cdr", context=context
            )

    def publish(self, topic: str, data: bytes, stamp: float) -> None:
        """Send one message to whoever looks at its topic; `stamp` is now, s since 1970."""
        self._channels[topic].log(data, log_time=int(1e9 * stamp))
        self.sent += 1

    def close(self) -> None:
        """Take the topics away, and end the server."""
        for channel in self._channels.values():
            channel.close()
        self._server.stop()

    def __enter__(self) -> FoxgloveServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _sdk() -> Any:
    try:
        import foxglove
    except ImportError:
        raise InputError("foxglove-sdk is not installed; pip install 'trueflight[foxglove]'") from None
    return foxglove


def layout(vehicle: str) -> dict[str, Any]:
    """A layout that Foxglove and Lichtblick import: the vehicle and its paths in 3D, position beside reference, body
    rates beside their command, and diagnostics."""
    name = {key: topic.name for key, topic in topics_of(vehicle).items()}
    body = f"{ros_name(vehicle)}/base_link"
    lines = {
        "Plot!position": ("position (m)", [
            (f"{name[topic]}.{pose}.{axis}", f"{axis}{said}")
            for axis in "xyz"
            for topic, pose, said in (
                ("odometry", "pose.pose.position", ""), ("reference", "pose.position", " reference"),
            )
        ]),
        "Plot!rates": ("body rates (rad/s)", [
            (f"{name[topic]}.{twist}.{axis}", f"{'pqr'['xyz'.index(axis)]}{said}")
            for axis in "xyz"
            for topic, twist, said in (
                ("command", "twist.angular", " command"), ("odometry", "twist.twist.angular", ""),
            )
        ]),
    }  # fmt: skip
    plots = {
        panel: {
            "foxglovePanelTitle": title,
            "paths": [
                {"value": value, "label": label, "enabled": True, "timestampMethod": "headerStamp"}
                for value, label in paths
            ],
            "showLegend": True,
            "legendDisplay": "floating",
            "followingViewWidth": 30,
        }
        for panel, (title, paths) in lines.items()
    }
    scene = {
        "followTf": MAP,
        "followMode": "follow-none",
        "cameraState": {"distance": 12, "phi": 65, "thetaOffset": 45, "perspective": True},
        "layers": {
            "grid": {
                "layerId": "foxglove.Grid",
                "instanceId": "grid",
                "visible": True,
                "size": 10,
                "divisions": 10,
            }
        },
        "transforms": {f"frame:{body}": {"visible": True}},
        "topics": {
            name["path"]: {"visible": True, "type": "line", "lineWidth": 0.03, "gradient": ["#4e98e2ff"] * 2},
            name["reference_path"]: {
                "visible": True,
                "type": "line",
                "lineWidth": 0.02,
                "gradient": ["#f5774dff"] * 2,
            },
            name["reference"]: {"visible": True, "type": "axis", "axisScale": 0.5},
        },
    }
    return {
        "configById": {
            "3D!scene": scene,
            **plots,
            "DiagnosticSummary!all": {"topicToRender": "/diagnostics"},
            "DiagnosticStatusPanel!flight": {
                "topicToRender": "/diagnostics",
                "selectedHardwareId": vehicle,
                "selectedName": f"trueflight: {vehicle}: flight",
            },
        },
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "splitPercentage": 55,
            "first": {
                "direction": "column", "splitPercentage": 65, "first": "3D!scene",
                "second": {
                    "direction": "row", "first": "DiagnosticSummary!all", "second": "DiagnosticStatusPanel!flight",
                },
            },
            "second": {"direction": "column", "first": "Plot!position", "second": "Plot!rates"},
        },
    }  # fmt: skip
