"""The behaviour of the authors' released code (QS3, 2022), where qs3 does better by default.

`released=yes` brings all of it back for domain=specklenet10. Each part can be had alone, as
`released=views` or `released=[views,grid]`, or key by key (conf/released):

| part    | released                                  | default here                           |
|---------|-------------------------------------------|----------------------------------------|
| views   | cameras on half the circle; jitter normal, | whole circle; jitter uniform, the same |
|         | growing with the view's index, added to   | for all views, about the axes of the   |
|         | Euler angles                              | camera                                 |
| matcher | StereoBM's bias of +0.029 px kept (-3 mm  | subtracted; all columns                |
|         | at 4 m); the left 168 columns are blind   |                                        |
| grid    | columns and rows 4 i kept; pixel centres  | the middle of each step; pixel centres |
|         | taken half a pixel wrong (1.3 mm at 4 m)  | where they are                         |
| crop    | no margin: at the box's sides only errors | 3 cm margin around the object's own    |
|         | inwards survive; the box is that of the   | box: errors of both signs survive      |
|         | turned corners of the mesh's box          |                                        |
| light   | spot of 300 W and strength 6, fill light, | exposure to the object, linear 8-bit   |
|         | grey world; Filmic tone curve, 8 bits, no | sensor, shot and read noise; one tile, |
|         | noise; 3 x 3 tiles, dots of 3.0 x 3.8 px, | square dots; 16 samples a pixel        |
|         | interpolated as stored; 128 samples       |                                        |

The numbers of a disparity search (160, block 19), the depth window (1 to 6 m), the distances and
the elevations are the released ones in both.

`light` converts the released scene to ours. A spot of P watts and strength s lights a white
surface at 1 m to the radiance P s / (4 pi^2) = 45.6. The fill light, a square of 24.3 m at z = 2 m
with radiance 0.422, and the world of 0.0509 reach surfaces unevenly: upward faces get 0.41,
vertical ones 0.20, downward ones 0.05. Our ambient light is even: 0.27 is the mean over what a
camera at 20 to 50 degrees sees of a sphere, and of a cube.

Compared with the released scene itself, rendered by bpy 4.5 with the same slide, mesh and pose:

| 128 samples                        | square at 4 m, facing | a sofa            |
|------------------------------------|-----------------------|-------------------|
| correlation of the left images     | 0.997                 | 0.78              |
| mean grey value of the object      | 161 and 149           | 159 and 146       |
| share of pixels with a disparity   | 99.9 and 99.9 %       | 99.4 and 100.0 %  |
| median error of the disparity (px) | +0.029 and +0.029     | +0.023 and +0.026 |
| its sigma, off the silhouettes     | 0.083 and 0.088       | 0.122 and 0.109   |

(theirs, then ours). What is left is the uneven fill light (the sofa's seat is brighter than
its sides), the gloss of Blender's default material, light between surfaces, the spot's falloff
with cos^3 across the slide (at most 13 % at the object's rim), Blender's pixel filter, its dither
and its sampling noise. Dither makes the empty background less alike in both images, so that
about an eighth fewer pixels beyond a silhouette get a disparity there.

`poses=PATH` is another switch: the very poses that the authors published (`poses`, `placing`).
"""
