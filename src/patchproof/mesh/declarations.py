"""What mesh files can declare, and what the readers do with each declaration.

The reader of glTF looks extensions up by their names; those not listed are refused where required, else said.
"""

from __future__ import annotations

from patchproof.base.declared import Declaration

_CONVERT = "convert it first, such as with `gltf-transform cp IN.glb OUT.glb`, which writes it without compression"
_EXTENSION, _GLTF, _OBJ, _PLY, _STL = "glTF extension", "glTF", "OBJ", "PLY", "STL"

DECLARED = (
    Declaration(_GLTF, "asset.version other than 2.x", "refused", "export as glTF 2.0"),
    Declaration(_GLTF, "extensionsRequired", "refused", "where an extension is not in this list"),
    Declaration(_GLTF, "extensionsUsed", "said", "where an extension is not in this list"),
    Declaration(_GLTF, "accessors: integers, normalized, strided, sparse, without a view", "used", "as numbers"),
    Declaration(_GLTF, "data shorter than declared, indices out of range or reserved", "refused", "export it again"),
    Declaration(_GLTF, "a JSON key twice", "refused", "export it again"),
    Declaration(_GLTF, "modes: triangles, strips, fans", "used", "as triangles"),
    Declaration(_GLTF, "modes: points, lines", "said", "left out"),
    Declaration(_GLTF, "scene, scenes", "used", "that scene, else the first; said if there are several"),
    Declaration(_GLTF, "nodes with meshes outside of the scene", "said", "left out"),
    Declaration(_GLTF, "node transforms, mirrored ones too", "used", "faces stay outward"),
    Declaration(_GLTF, "morph targets with weights", "used", "the weights of the node, else of the mesh"),
    Declaration(_GLTF, "skins", "said", "the mesh as it was modeled, without its joints' pose"),
    Declaration(_GLTF, "base color factor, texture, COLOR_0", "used", "multiplied as linear light"),
    Declaration(_GLTF, "TEXCOORD_n of the base color", "used", "the set that the texture names"),
    Declaration(_GLTF, "wrapS, wrapT", "used", "textures are drawn out; said where that takes over 8192 texels"),
    Declaration(_GLTF, "magFilter NEAREST", "said", "drawn smooth"),
    Declaration(_GLTF, "images as files, data URIs, buffer views", "used", "formats as photographs'"),
    Declaration(_GLTF, "alphaMode MASK, BLEND", "said", "drawn opaque"),
    Declaration(_GLTF, "doubleSided", "used", "every face is seen from both sides"),
    Declaration(_GLTF, "emission, metal, maps of normals, roughness and occlusion", "said", "left out, by name"),
    Declaration(_GLTF, "cameras, animations", "said", "left out"),
    Declaration(_EXTENSION, "KHR_mesh_quantization", "used", "integers as coordinates"),
    Declaration(_EXTENSION, "KHR_texture_transform", "used", "of the base color: offset, rotation, scale, texCoord"),
    Declaration(_EXTENSION, "EXT_mesh_gpu_instancing", "used", "a part for every instance"),
    Declaration(_EXTENSION, "KHR_node_visibility", "used", "hidden nodes are left out and said"),
    Declaration(_EXTENSION, "KHR_materials_pbrSpecularGlossiness", "used", "its diffuse color and texture"),
    Declaration(_EXTENSION, "EXT_texture_webp", "used", "as other textures"),
    Declaration(_EXTENSION, "EXT_texture_avif", "used", "as other textures"),
    Declaration(_EXTENSION, "KHR_materials_unlit", "said", "its surfaces are lit as others are"),
    Declaration(_EXTENSION, "KHR_materials_variants", "said", "each mesh has its first material"),
    Declaration(_EXTENSION, "KHR_lights_punctual", "said", "the scene file has lights of its own"),
    Declaration(_EXTENSION, "KHR_draco_mesh_compression", "refused", _CONVERT),
    Declaration(_EXTENSION, "EXT_meshopt_compression", "refused", _CONVERT),
    Declaration(_EXTENSION, "KHR_meshopt_compression", "refused", _CONVERT),
    Declaration(_EXTENSION, "KHR_texture_basisu", "refused", "where there is no other image: export textures as PNG"),
    Declaration(_OBJ, "polygons, concave ones too", "used", "cut into triangles within their outline"),
    Declaration(_OBJ, "relative indices", "used", "from where they stand"),
    Declaration(_OBJ, "indices of nothing, faces with two corners", "refused", "export it again"),
    Declaration(_OBJ, "vertex colors after v", "used", "as sRGB; said and left out where there is a texture"),
    Declaration(_OBJ, "weights w, smoothing groups", "said", "left out"),
    Declaration(_OBJ, "points, lines, curves, surfaces, unknown lines", "said", "left out, by keyword"),
    Declaration(_OBJ, "several mtllib lines, several names in one", "used", "all are read"),
    Declaration(_OBJ, "a missing MTL file, usemtl that none defines", "said", "gray 0.5"),
    Declaration("MTL", "Kd, map_Kd", "used", "multiplied; Kd 0 0 0 beside a map counts as 1 1 1"),
    Declaration("MTL", "map_Kd relative to its MTL", "used", "else relative to the OBJ; refused if missing"),
    Declaration("MTL", "map_Kd -s, -o, -clamp, -mm", "used", "scaled, shifted, last texels continued, codes changed"),
    Declaration("MTL", "map_Kd with other options", "said", "left out, by name"),
    Declaration("MTL", "d, Tr, map_d", "said", "drawn opaque"),
    Declaration("MTL", "Ke, other maps", "said", "left out, by name"),
    Declaration(_PLY, "polygons, concave ones too", "used", "cut into triangles within their outline"),
    Declaration(_PLY, "texture coordinates of vertices or of faces' corners", "used", "v up"),
    Declaration(_PLY, "one texture", "used", "its file beside the mesh"),
    Declaration(_PLY, "several textures", "refused", "export as OBJ or GLB"),
    Declaration(_PLY, "colors of vertices or faces, of any type", "used", "as sRGB"),
    Declaration(_PLY, "other elements", "said", "left out, by name"),
    Declaration(_STL, "several solids", "used", "as one object"),
    Declaration(_STL, "COLOR= in the header, colors of facets", "said", "left out"),
)
