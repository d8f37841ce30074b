"""External files of a user's MJCF become part of it, because a log carries one MJCF text and nothing else."""

import mujoco
import numpy as np

MOST_VERTICES = 4000
"""A mesh with more is carried as its convex hull's bounding box: a log is not the place for a million triangles."""


def embed(spec: mujoco.MjSpec) -> None:
    """Put meshes into the text, drop textures, and fix inertias first, so that no number of the physics changes."""
    if not any(m.file for m in spec.meshes) and not any(t.file for t in spec.textures):
        return
    model = spec.copy().compile()  # a mesh that has been compiled keeps what it has read
    for body in spec.bodies[1:]:
        compiled = model.body(body.name)
        body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
        body.mass, body.ipos, body.iquat = compiled.mass[0], compiled.ipos, compiled.iquat
        body.inertia = compiled.inertia
    for mesh in spec.meshes:
        if mesh.file:
            _inline(mesh, model)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in [t for t in spec.textures if t.file]:
        spec.delete(texture)


def _inline(mesh: mujoco.MjsMesh, model: mujoco.MjModel) -> None:
    """Vertices and faces in the frame and units of the file that they came from."""
    compiled = model.mesh(mesh.name)
    k = compiled.id
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[k])
    first, count = compiled.vertadr[0], compiled.vertnum[0]
    points = model.mesh_vert[first : first + count] @ turn.reshape(3, 3).T + model.mesh_pos[k]
    start, faces = compiled.faceadr[0], compiled.facenum[0]
    triangles = model.mesh_face[start : start + faces]
    if count > MOST_VERTICES:
        low, high = points.min(axis=0), points.max(axis=0)
        points = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        triangles = np.zeros((0, 3), dtype=int)  # MuJoCo takes the hull of the corners
    mesh.file, mesh.scale = "", [1.0, 1.0, 1.0]
    mesh.refpos, mesh.refquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    mesh.uservert, mesh.userface = points.ravel().tolist(), triangles.ravel().tolist()
    mesh.usernormal, mesh.usertexcoord, mesh.userfacetexcoord = [], [], []
