"""Constants that fields and their networks share, in training (torch) and inference (OpenVINO, C)."""

GEOMETRY_CHANNELS = 5  # of a mixture of two logistics: mu_1, s_1, mu_2, s_2 in metres, weight of component 1
UNSURE_SPREAD = 0.10  # spread of computed depth, as a fraction of it, from which on it counts as a hole
MIN_DEPTH_M = 0.05  # points nearer to a source camera than this count as behind it
SURFACE_CHANNELS = 5  # of ``surface_maps``

# The image encoder.
COLOUR_MEAN, COLOUR_DEVIATION = 0.45, 0.25
BACKBONE_STAGES = (  # blocks of one output stride: (channels in, channels out, kernel, stride, expansion) of each
    ((32, 16, 3, 1, 1),),
    ((16, 24, 3, 2, 6), (24, 24, 3, 1, 6)),
    ((24, 40, 5, 2, 6), (40, 40, 5, 1, 6)),
    (
        (40, 80, 3, 2, 6),
        (80, 80, 3, 1, 6),
        (80, 80, 3, 1, 6),
        (80, 112, 5, 1, 6),
        (112, 112, 5, 1, 6),
        (112, 112, 5, 1, 6),
    ),
    ((112, 192, 5, 2, 6), (192, 192, 5, 1, 6), (192, 192, 5, 1, 6), (192, 192, 5, 1, 6)),
)
BACKBONE_MEAN, BACKBONE_DEVIATION = 127 / 255, 128 / 255  # of the colours in [0, 1] that the published weights expect
NORM_EPSILON = 1e-3  # of the backbone's batch norms
TORCH_NORM_EPSILON = 1e-5  # of all others

# S-Ray.
NEAR_M, FAR_M = 0.2, 12.0
MEASURED_SHIFT = 0.05  # a measured depth may be moved by at most this fraction
MEASURED_SCALE = 0.01  # initial spread of a measured depth, fraction of z
PREDICTED_SCALE = 0.25  # initial spread of a predicted depth, fraction of z
COMMON_FOCAL = 0.69  # focal length in image widths at which a predicted depth is taken as it is
COLOUR_SCALE = 4.0  # of colours next to features: colours that differ by a quarter have a variance of about 1
OWN_DENSITY_OFFSET = 6.0  # at the start the views decide alone: 0.0025 / m of density of its own
LEAST_VISIBILITY = 1e-4  # a sample that is hidden from every view that it projects into takes all of them alike
BACKGROUND_M = 1e4  # where a ray ends that meets nothing
OWN_RADIUS_M = 1e-3  # a view whose camera is that near to the ray's origin is the query's own
TAU = 0.02  # Eq. 12: view weights lie in (tau / m, 1 / (tau m))
HIDDEN = 0.05  # visibility below which a view is left out where another one sees the sample
LABEL_UNCERTAINTY = 0.05  # hit probability at which a label that a view carries over counts by half
CUES = 4  # hit, visibility, view cosine, spread of the depth: what a view knows of a sample next to its feature
SURFACE_CUES = CUES + 1  # and whether the view is the query's own, for a token at the surface
