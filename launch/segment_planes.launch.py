"""Start segment_planes: ros2 launch rangeseg_ros segment_planes.launch.py depth:=/camera/depth."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
SHARE = FindPackageShare('rangeseg_ros')

# Topics that the RViz configuration shows.
SHOWN = ('overlay', 'markers', 'ground', 'obstacles')

ARGUMENTS = {
    'namespace': ('', 'Namespace of the node'),
    'name': ('segment_planes', 'Name of the node'),
    'depth': ('depth/image_rect', 'Depth image; its camera_info is the sibling topic'),
    'camera_info': ('depth/camera_info', 'Intrinsics, where they are not beside the image'),
    'points': ('depth/points', 'Organised cloud (input:=points)'),
    'imu': ('imu', 'Accelerometer (use_imu:=true)'),
    'input': ('', 'image, compressed_depth or points; empty: as the parameter file says'),
    'use_imu': ('', 'true or false; empty: as the parameter file says'),
    'use_sim_time': ('', 'true or false; empty: as the parameter file says'),
    'log_level': ('info', 'debug, info, warn, error or fatal'),
    'params_file': (
        PathJoinSubstitution([SHARE, 'params', 'segment_planes.yaml']),
        'ROS parameter file',
    ),
    'extra_params_file': ('', 'Another one, which wins'),
    'fastdds_profile': (
        EnvironmentVariable(
            PROFILE,
            default_value=PathJoinSubstitution([SHARE, 'params', 'fastdds_large_images.xml']),
        ),
        'Fast DDS profile, for images over 512 KiB, which camera and listeners need as well; '
        'empty: none',
    ),
    'rviz': ('false', 'true: also start RViz'),
    'rviz_frame': ('camera_depth_optical_frame', 'Frame that RViz shows everything in'),
}


# A word that is none of these must not pass for false.
SWITCHES = ('use_imu', 'use_sim_time', 'rviz')
CHOICES = ['true', 'false', 'True', 'False']


def _nodes(context):
    """The node, and RViz if it is wanted, by the values of the arguments."""
    value = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    parameters = [value['params_file']]
    if value['extra_params_file']:
        parameters.append(value['extra_params_file'])
    given = {'input': value['input']} if value['input'] else {}
    for switch in ('use_imu', 'use_sim_time'):
        if value[switch]:
            given[switch] = value[switch].lower() == 'true'
    if given:
        parameters.append(given)
    environment = {PROFILE: value['fastdds_profile']} if value['fastdds_profile'] else {}
    nodes = [
        Node(
            package='rangeseg_ros',
            executable='segment_planes',
            name=value['name'],
            namespace=value['namespace'],
            parameters=parameters,
            remappings=[
                ('depth/image_rect', value['depth']),
                ('depth/camera_info', value['camera_info']),
                ('depth/points', value['points']),
                ('imu', value['imu']),
            ],
            ros_arguments=['--log-level', value['log_level']],
            additional_env=environment,
            output='screen',
        )
    ]
    if value['rviz'].lower() == 'true':
        parts = [part for part in (value['namespace'].strip('/'), value['name']) if part]
        private = '/' + '/'.join(parts)
        config = PathJoinSubstitution([SHARE, 'rviz', 'segment_planes.rviz'])
        nodes.append(
            Node(
                package='rviz2',
                executable='rviz2',
                arguments=['-d', config, '-f', value['rviz_frame']],
                remappings=[(f'/segment_planes/{name}', f'{private}/{name}') for name in SHOWN],
                additional_env=environment,
            )
        )
    return nodes


def generate_launch_description():
    """Describe the arguments and the nodes."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(
                    name,
                    default_value=default,
                    description=description,
                    choices=[*CHOICES, *([] if default else [''])] if name in SWITCHES else None,
                )
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=_nodes),
        ]
    )
