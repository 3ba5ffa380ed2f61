"""Print the desktop's description of scene files (shared-mime-info), made of the table of formats."""

from langsplat_core.io.scenes import formats

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<mime-info xmlns="http://www.freedesktop.org/standards/shared-mime-info">'
NAMES = {
    "model/x-gaussian-splat": "3D Gaussian scene",
    "model/x-ply": "3D points, mesh or Gaussians (PLY)",
    "model/gltf-binary": "3D scene (glTF, binary)",
    "model/gltf+json": "3D scene (glTF)",
}
FURTHER = {
    "model/x-gaussian-splat": ['<glob pattern="*.compressed.ply" weight="60"/>'],
    "model/x-ply": [
        '<magic priority="50">',
        '  <match type="string" offset="0" value="ply\\n"/>',
        '  <match type="string" offset="0" value="ply\\r\\n"/>',
        "</magic>",
    ],
}


def mime_info() -> str:
    """Return the XML, a glob for each suffix."""
    lines = [HEAD]
    for mime, name in NAMES.items():
        globs = [f'<glob pattern="*{row.suffix}"/>' for row in formats() if row.mime == mime]
        inside = [f"<comment>{name}</comment>", *FURTHER.get(mime, []), *globs]
        lines += [f'  <mime-type type="{mime}">', *(f"    {line}" for line in inside), "  </mime-type>"]
    return "\n".join([*lines, "</mime-info>"])


if __name__ == "__main__":
    print(mime_info())
