"""Settings of the ROS 2 reference in its image."""

import json

from needs import ros2_image

from adaptune.odometry.systems.ros2_system import Ros2Settings

TEMPLATE = """\
/**:
  ros__parameters:
    points_topic: {points}
    use_sim_time: {sim_time}
    voxel_size: 0.9
    icp: {{max_correspondence_distance: 1.5, max_iterations: 25}}
    max_range: 60.0
    other: 1
    imitate: {imitate}
"""


def ros2(file, points="/points", imitate=(), sim_time=False, **settings):
    """Settings of the ROS 2 reference, in its image."""
    text = {"imitate": json.dumps(dict(imitate)), "sim_time": json.dumps(sim_time)}
    file.write_text(TEMPLATE.format(points=points, **text))
    command = ("adaptune-reference-ros2", "--params-file", "{parameters}")
    image = settings.pop("image") if "image" in settings else ros2_image()
    given = {"image": image, "command": command, "odometry": "/odometry", "rate": 0.0}
    return Ros2Settings(template=str(file), **(given | settings))
