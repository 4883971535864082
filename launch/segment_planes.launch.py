"""Start segment_planes: ros2 launch rangeseg_ros segment_planes.launch.py depth:=/camera/depth."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    """Describe the node and its arguments."""
    share = FindPackageShare('rangeseg_ros')
    arguments = [
        DeclareLaunchArgument('namespace', default_value='', description='Namespace of the node'),
        DeclareLaunchArgument(
            'depth',
            default_value='depth/image_rect',
            description='Depth image; its camera_info is the sibling topic',
        ),
        DeclareLaunchArgument(
            'camera_info',
            default_value='depth/camera_info',
            description='Intrinsics, where they are not beside the image',
        ),
        DeclareLaunchArgument(
            'points', default_value='depth/points', description='Organised cloud (input: points)'
        ),
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution([share, 'params', 'segment_planes.yaml']),
            description='ROS parameter file',
        ),
    ]
    node = Node(
        package='rangeseg_ros',
        executable='segment_planes',
        name='segment_planes',
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('params_file')],
        remappings=[
            ('depth/image_rect', LaunchConfiguration('depth')),
            ('depth/camera_info', LaunchConfiguration('camera_info')),
            ('depth/points', LaunchConfiguration('points')),
        ],
        output='screen',
    )
    return LaunchDescription([*arguments, node])
