"""DepthScanNet10 from raw ScanNet: the objects of ten classes as the depth camera measured them.

The paper (section 4, "Benchmarking Data") describes the dataset and no code for it was released.
What is fixed there: instance masks crop the depth images, only crops of more than 1,000 points
are kept, those of 10 viewpoints are fused, and 2,048 points are kept; scenes and split are those
of PointDA-10's ScanNet10. What is not, is decided in `extraction.py` and `objects.py`, and said.

    sens.py           the .sens recording: calibration, poses, depth, one frame at a time
    masks.py          the zips of mask images
    labels.py         label map, aggregation.json, scene lists, names of the ten classes
    registration.py   which mask pixel a depth pixel falls on
    objects.py        viewpoints, fusion, sampling
    scene.py          one scene to its objects
    extraction.py     all scenes: processes, resume, the dataset
    scene_parts.py    what is written of each scene on the way
    cli.py            the command: qs3 scannet --help

Facts about ScanNet's files were taken from its public tools (github.com/ScanNet/ScanNet:
SensReader, AnnotationTools, BenchmarkScripts) and README; PointDA-10's names from
github.com/canqin001/PointDAN, data_extraction/ScanNet.
"""
