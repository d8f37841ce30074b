"""Embeds the external files of a user's MJCF in its text, because a log holds one MJCF text and nothing else."""

import mujoco
import numpy as np

MOST_VERTICES = 4000
"""A mesh with more vertices is replaced by its bounding box: a million triangles do not belong in a log."""


def embed(spec: mujoco.MjSpec) -> None:
    """Put meshes and height fields into the text and drop textures; masses and inertias keep the values of the original."""
    textures = [t for t in spec.textures if t.file or any(t.cubefiles)]
    if not textures and not any(asset.file for asset in (*spec.meshes, *spec.hfields)):
        return
    copied = spec.copy()  # compiling leaves file data in a spec's meshes, so a copy is compiled
    model = copied.compile()
    for body, source in zip(spec.bodies[1:], copied.bodies[1:], strict=True):
        compiled = model.body(source.id)
        body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
        body.mass, body.ipos, body.iquat = compiled.mass[0], compiled.ipos, compiled.iquat
        body.inertia = compiled.inertia
    for mesh, source in zip(spec.meshes, copied.meshes, strict=True):
        if mesh.file:
            _inline(mesh, model, source.id)
    for field, source in zip(spec.hfields, copied.hfields, strict=True):
        if field.file:
            _inline_heights(field, model, source.id)
    for material in spec.materials:
        if textures:
            material.textures = [""] * len(material.textures)
    for texture in textures:
        spec.delete(texture)


def _inline_heights(field: mujoco.MjsHField, model: mujoco.MjModel, k: int) -> None:
    """Store the heights in the text, scaled to 0 to 1 as MuJoCo stores them."""
    first, rows, columns = int(model.hfield_adr[k]), int(model.hfield_nrow[k]), int(model.hfield_ncol[k])
    field.file, field.nrow, field.ncol = "", rows, columns
    field.userdata = model.hfield_data[first : first + rows * columns].tolist()


def _inline(mesh: mujoco.MjsMesh, model: mujoco.MjModel, k: int) -> None:
    """Store vertices and faces in the text, in the file's frame with the mesh's scale and reference pose applied."""
    compiled = model.mesh(k)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[k])
    first, count = compiled.vertadr[0], compiled.vertnum[0]
    points = model.mesh_vert[first : first + count] @ turn.reshape(3, 3).T + model.mesh_pos[k]
    start, faces = compiled.faceadr[0], compiled.facenum[0]
    triangles = model.mesh_face[start : start + faces]
    if count > MOST_VERTICES:
        low, high = points.min(axis=0), points.max(axis=0)
        points = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        triangles = np.zeros((0, 3), dtype=int)  # MuJoCo uses the convex hull of the corners
    mesh.file, mesh.scale = "", [1.0, 1.0, 1.0]
    mesh.refpos, mesh.refquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    mesh.uservert, mesh.userface = points.ravel().tolist(), triangles.ravel().tolist()
    mesh.usernormal, mesh.usertexcoord, mesh.userfacetexcoord = [], [], []
