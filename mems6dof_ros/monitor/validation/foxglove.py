"""The Foxglove bridge, read by a client that knows only the protocol."""

from __future__ import annotations

import asyncio
import json
import math
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from mems6dof_ros.figures import Figure, at_least, at_most, exactly
from mems6dof_ros.monitor.validation.nodes import namespace, node, synthetic
from mems6dof_ros.nodes.recorder import KNOWN_TYPES
from mems6dof_ros.nodes.system import NodeSpec
from mems6dof_ros.recording import topics


async def foxglove_messages(
    url: str, wanted: Mapping[str, int]
) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """What a client that shares no code with the bridge gets: the channels advertised by topic, and so many
    decoded messages of each topic wanted, with the schemas that it is sent."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    channels: dict[str, Any] = {}
    decoded: dict[str, list[Any]] = {topic: [] for topic in wanted}
    decoders: dict[int, tuple[str, Any]] = {}
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(url, protocols=["foxglove.sdk.v1"], max_msg_size=0) as socket,
    ):
        while any(len(decoded[topic]) < count for topic, count in wanted.items()):
            message = await socket.receive(30)
            if message.type is aiohttp.WSMsgType.TEXT:
                for channel in json.loads(message.data).get("channels", []):
                    topic = channel["topic"]
                    channels[topic] = channel
                    if topic not in wanted:
                        continue
                    number = len(decoders)
                    schema = Schema(
                        1, channel["schema"].encode(), channel["schemaEncoding"], channel["schemaName"]
                    )
                    decoders[number] = topic, DecoderFactory().decoder_for(channel["encoding"], schema)
                    request = {"id": number, "channelId": channel["id"]}
                    await socket.send_json({"op": "subscribe", "subscriptions": [request]})
            elif message.type is aiohttp.WSMsgType.BINARY and message.data[0] == 1:  # message data
                number, _ = struct.unpack_from("<IQ", message.data, 1)
                topic, decode = decoders[number]
                decoded[topic].append(decode(message.data[13:]))
    return channels, decoded


def measure(work: Path, tell: Callable[[str], None], **_: Any) -> Iterator[Figure]:
    """Poses and the rest through the bridge, read by a client that knows only the protocol."""
    name = namespace()
    counts = {topics.POSE_6DOF: 300, topics.LOCALIZATIONS: 100, topics.FRAME_INFO: 100, topics.IMAGE: 2}
    wanted = {f"/{name}/{topic}": count for topic, count in counts.items()}
    bridge = NodeSpec("foxglove_bridge", {"port": 0})
    with (
        synthetic(name, image_every=1),
        node(bridge, name, "Foxglove WebSocket: ") as (url, _pid),
    ):
        tell("a client that shares no code with the bridge listens to it")
        channels, decoded = asyncio.run(asyncio.wait_for(foxglove_messages(url, wanted), 60))
    poses = decoded[f"/{name}/{topics.POSE_6DOF}"]
    yield at_least("Foxglove: topics with their definitions", len(channels), len(KNOWN_TYPES))
    missing = int(np.sum(np.diff([pose.cycle for pose in poses]) != 1))
    yield exactly(f"Foxglove: cycles missing among {len(poses)} poses decoded", missing, 0)
    turned = np.diff([pose.psi for pose in poses if pose.status == 1])
    yield at_most(
        "Foxglove: median rotation per cycle, off by, mrad",
        abs(float(np.median(turned)) - math.radians(4.5)) * 1e3,
        2.0,
    )
    particles = [len(found.x) for found in decoded[f"/{name}/{topics.LOCALIZATIONS}"]]
    yield at_least("Foxglove: particles in each of 100 frames", min(particles), 20)
    image = decoded[f"/{name}/{topics.IMAGE}"][0]
    yield exactly("Foxglove: bytes missing of an image", image.step * image.height - len(image.data), 0)
