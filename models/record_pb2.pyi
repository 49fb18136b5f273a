from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Vector3(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quaternion(_message.Message):
    __slots__ = ("w", "x", "y", "z")
    W_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    w: float
    x: float
    y: float
    z: float
    def __init__(self, w: _Optional[float] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Command(_message.Message):
    __slots__ = ("thrust", "body_rate")
    THRUST_FIELD_NUMBER: _ClassVar[int]
    BODY_RATE_FIELD_NUMBER: _ClassVar[int]
    thrust: float
    body_rate: Vector3
    def __init__(self, thrust: _Optional[float] = ..., body_rate: _Optional[_Union[Vector3, _Mapping]] = ...) -> None: ...

class Tick(_message.Message):
    __slots__ = ("vehicle_time_us", "host_time_ns", "position", "velocity", "quaternion", "angular_velocity", "specific_force", "position_reference", "velocity_reference", "acceleration_reference", "yaw_reference", "feedback", "correction", "correction_raw", "thrust_command", "body_rate_command", "battery_voltage", "rotor_speed", "model", "controller", "flight_mode", "armed", "phase", "guard", "interval", "latency", "inference", "setpoint_sent", "trajectory", "shadow", "shadow_raw", "trim", "age", "overtaken", "learning", "learnt_names", "learnt", "learnt_deviation", "learnt_acting")
    VEHICLE_TIME_US_FIELD_NUMBER: _ClassVar[int]
    HOST_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_FIELD_NUMBER: _ClassVar[int]
    ANGULAR_VELOCITY_FIELD_NUMBER: _ClassVar[int]
    SPECIFIC_FORCE_FIELD_NUMBER: _ClassVar[int]
    POSITION_REFERENCE_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_REFERENCE_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_REFERENCE_FIELD_NUMBER: _ClassVar[int]
    YAW_REFERENCE_FIELD_NUMBER: _ClassVar[int]
    FEEDBACK_FIELD_NUMBER: _ClassVar[int]
    CORRECTION_FIELD_NUMBER: _ClassVar[int]
    CORRECTION_RAW_FIELD_NUMBER: _ClassVar[int]
    THRUST_COMMAND_FIELD_NUMBER: _ClassVar[int]
    BODY_RATE_COMMAND_FIELD_NUMBER: _ClassVar[int]
    BATTERY_VOLTAGE_FIELD_NUMBER: _ClassVar[int]
    ROTOR_SPEED_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    FLIGHT_MODE_FIELD_NUMBER: _ClassVar[int]
    ARMED_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    GUARD_FIELD_NUMBER: _ClassVar[int]
    INTERVAL_FIELD_NUMBER: _ClassVar[int]
    LATENCY_FIELD_NUMBER: _ClassVar[int]
    INFERENCE_FIELD_NUMBER: _ClassVar[int]
    SETPOINT_SENT_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORY_FIELD_NUMBER: _ClassVar[int]
    SHADOW_FIELD_NUMBER: _ClassVar[int]
    SHADOW_RAW_FIELD_NUMBER: _ClassVar[int]
    TRIM_FIELD_NUMBER: _ClassVar[int]
    AGE_FIELD_NUMBER: _ClassVar[int]
    OVERTAKEN_FIELD_NUMBER: _ClassVar[int]
    LEARNING_FIELD_NUMBER: _ClassVar[int]
    LEARNT_NAMES_FIELD_NUMBER: _ClassVar[int]
    LEARNT_FIELD_NUMBER: _ClassVar[int]
    LEARNT_DEVIATION_FIELD_NUMBER: _ClassVar[int]
    LEARNT_ACTING_FIELD_NUMBER: _ClassVar[int]
    vehicle_time_us: int
    host_time_ns: int
    position: Vector3
    velocity: Vector3
    quaternion: Quaternion
    angular_velocity: Vector3
    specific_force: Vector3
    position_reference: Vector3
    velocity_reference: Vector3
    acceleration_reference: Vector3
    yaw_reference: float
    feedback: Command
    correction: Vector3
    correction_raw: Vector3
    thrust_command: float
    body_rate_command: Vector3
    battery_voltage: float
    rotor_speed: _containers.RepeatedScalarFieldContainer[float]
    model: str
    controller: str
    flight_mode: str
    armed: bool
    phase: str
    guard: str
    interval: float
    latency: float
    inference: float
    setpoint_sent: bool
    trajectory: str
    shadow: str
    shadow_raw: Vector3
    trim: Vector3
    age: float
    overtaken: int
    learning: str
    learnt_names: str
    learnt: _containers.RepeatedScalarFieldContainer[float]
    learnt_deviation: _containers.RepeatedScalarFieldContainer[float]
    learnt_acting: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, vehicle_time_us: _Optional[int] = ..., host_time_ns: _Optional[int] = ..., position: _Optional[_Union[Vector3, _Mapping]] = ..., velocity: _Optional[_Union[Vector3, _Mapping]] = ..., quaternion: _Optional[_Union[Quaternion, _Mapping]] = ..., angular_velocity: _Optional[_Union[Vector3, _Mapping]] = ..., specific_force: _Optional[_Union[Vector3, _Mapping]] = ..., position_reference: _Optional[_Union[Vector3, _Mapping]] = ..., velocity_reference: _Optional[_Union[Vector3, _Mapping]] = ..., acceleration_reference: _Optional[_Union[Vector3, _Mapping]] = ..., yaw_reference: _Optional[float] = ..., feedback: _Optional[_Union[Command, _Mapping]] = ..., correction: _Optional[_Union[Vector3, _Mapping]] = ..., correction_raw: _Optional[_Union[Vector3, _Mapping]] = ..., thrust_command: _Optional[float] = ..., body_rate_command: _Optional[_Union[Vector3, _Mapping]] = ..., battery_voltage: _Optional[float] = ..., rotor_speed: _Optional[_Iterable[float]] = ..., model: _Optional[str] = ..., controller: _Optional[str] = ..., flight_mode: _Optional[str] = ..., armed: _Optional[bool] = ..., phase: _Optional[str] = ..., guard: _Optional[str] = ..., interval: _Optional[float] = ..., latency: _Optional[float] = ..., inference: _Optional[float] = ..., setpoint_sent: _Optional[bool] = ..., trajectory: _Optional[str] = ..., shadow: _Optional[str] = ..., shadow_raw: _Optional[_Union[Vector3, _Mapping]] = ..., trim: _Optional[_Union[Vector3, _Mapping]] = ..., age: _Optional[float] = ..., overtaken: _Optional[int] = ..., learning: _Optional[str] = ..., learnt_names: _Optional[str] = ..., learnt: _Optional[_Iterable[float]] = ..., learnt_deviation: _Optional[_Iterable[float]] = ..., learnt_acting: _Optional[_Iterable[float]] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("vehicle_time_us", "host_time_ns", "level", "kind", "text")
    VEHICLE_TIME_US_FIELD_NUMBER: _ClassVar[int]
    HOST_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    vehicle_time_us: int
    host_time_ns: int
    level: str
    kind: str
    text: str
    def __init__(self, vehicle_time_us: _Optional[int] = ..., host_time_ns: _Optional[int] = ..., level: _Optional[str] = ..., kind: _Optional[str] = ..., text: _Optional[str] = ...) -> None: ...
