"""Virtual flattening of hanging garments; see vflatten_ros.core for the method."""

from pkgutil import extend_path

# The generated messages (vflatten_ros.msg) live in another folder of the same name.
__path__ = extend_path(__path__, __name__)
