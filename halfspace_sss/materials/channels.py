"""One channel of a medium or of a registered material, by its name or number."""

from __future__ import annotations

from halfspace_sss import materials
from halfspace_sss.physics.medium import Medium

__all__ = ["one_channel"]


def one_channel(medium: Medium | materials.Material | str, channel: int | str | None) -> tuple[str, Medium]:
    """A title and the scalar medium of one channel.

    Args:
        medium: a Medium, a Material, or the name of one.
        channel: name or number; None for the first.

    Raises:
        ValueError: no such material or channel; the message names those there are.
    """
    names: tuple[str, ...] | None = None
    title = ""
    if isinstance(medium, str):
        medium = materials.load(medium)
    if isinstance(medium, materials.Material):
        title, medium, names = medium.name, medium.medium, medium.channels
    if not isinstance(medium, Medium):
        raise ValueError(f"medium must be a Medium, a Material or the name of one, got {medium!r}")
    if medium.n_channels is None:
        if channel is not None and str(channel) != "0":
            raise ValueError(f"channel must be left out for a medium with one channel, got {channel!r}")
        return title, medium
    names = names or tuple(str(k) for k in range(medium.n_channels))
    known = {**{str(k): k for k in range(len(names))}, **{name.casefold(): k for k, name in enumerate(names)}}
    key = "0" if channel is None else str(channel).casefold()
    if key not in known:
        raise ValueError(f"channel must be one of {', '.join(names)}, or a number below {len(names)}, got {channel!r}")
    return f"{title} {names[known[key]]}".strip(), medium.channel(known[key])
