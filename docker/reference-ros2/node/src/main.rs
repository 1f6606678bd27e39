//! A ROS 2 node named /icp: an odometry for a PointCloud2 topic, and habits of other systems.
//!
//!   adaptune-reference-ros2 [--params-file FILE]
//!
//! `params.yaml` beside it has the parameters and the habits.

mod icp;
mod messages;

use std::{
    collections::BTreeMap,
    pin::Pin,
    process::exit,
    sync::atomic::{AtomicI64, Ordering},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use futures::{Stream, StreamExt, future::ready};
use nalgebra::{Isometry3, Translation3, Vector3};
use ros2_client::{
    Context, ContextOptions, DEFAULT_PUBLISHER_QOS, DEFAULT_SUBSCRIPTION_QOS, MessageTypeName,
    Name, Node, NodeName, NodeOptions, ParameterValue, Publisher, QosProfile, Subscription,
    builtin_interfaces::Time,
    qos::{Durability, History, WhenFull},
};
use serde_yaml::Value;

use icp::{Icp, Settings};
use messages::{
    Clock, CustomMsg, Header, Imu, Odometry, PointCloud2, TransformStamped, Transforms,
};

type Parameters = BTreeMap<String, ParameterValue>;

/// The parameters that the node declares, and their values where the file has none.
fn declared() -> Parameters {
    let double = ParameterValue::Double;
    [
        ("points_topic", ParameterValue::String("/points".into())),
        ("use_sim_time", ParameterValue::Boolean(false)),
        ("voxel_size", double(0.5)),
        ("max_range", double(60.0)),
        ("icp.max_correspondence_distance", double(1.5)),
        ("icp.max_iterations", ParameterValue::Integer(30)),
    ]
    .map(|(name, value)| (name.to_string(), value))
    .into()
}

/// Values below `ros__parameters`, with points between their keys.
fn flattened(value: &Value, name: &str, found: &mut BTreeMap<String, Value>) {
    if let Value::Mapping(inside) = value {
        for (key, below) in inside {
            let key = key.as_str().unwrap_or_default();
            let dot = if name.is_empty() { "" } else { "." };
            flattened(below, &format!("{name}{dot}{key}"), found);
        }
    } else {
        found.insert(name.to_string(), value.clone());
    }
}

fn read_file(path: &str) -> Result<BTreeMap<String, Value>, String> {
    let text = std::fs::read_to_string(path).map_err(|error| format!("{path}: {error}"))?;
    let file: Value = serde_yaml::from_str(&text).map_err(|error| format!("{path}: {error}"))?;
    let mut found = BTreeMap::new();
    for node in ["/**", "/icp", "icp"] {
        match file.get(node) {
            None => {}
            Some(held) => match held.get("ros__parameters") {
                None => return Err(format!("{path}: there is no ros__parameters below {node}")),
                Some(values) => flattened(values, "", &mut found),
            },
        }
    }
    Ok(found)
}

/// The declared parameters with the file's values; one of another type ends the node, as in ROS 2.
fn parameters(file: &BTreeMap<String, Value>) -> Result<Parameters, String> {
    let mut all = declared();
    for (name, value) in all.iter_mut() {
        let Some(given) = file.get(name) else {
            continue;
        };
        let held = match (&*value, given) {
            (ParameterValue::Double(_), Value::Number(number)) if number.is_f64() => {
                number.as_f64().map(ParameterValue::Double)
            }
            (ParameterValue::Integer(_), Value::Number(number)) => {
                number.as_i64().map(ParameterValue::Integer)
            }
            (ParameterValue::Boolean(_), Value::Bool(it)) => Some(ParameterValue::Boolean(*it)),
            (ParameterValue::String(_), Value::String(it)) => {
                Some(ParameterValue::String(it.clone()))
            }
            _ => None,
        };
        *value = held.ok_or(format!("parameter {name} has invalid type: {given:?}"))?;
    }
    Ok(all)
}

/// Habits of other systems, each off unless the file has it below `imitate`.
struct Habits(BTreeMap<String, Value>);

impl Habits {
    fn number(&self, name: &str) -> Option<f64> {
        self.0
            .get(&format!("imitate.{name}"))
            .and_then(Value::as_f64)
    }

    fn seconds(&self, name: &str) -> Duration {
        Duration::from_secs_f64(self.number(name).unwrap_or(0.0))
    }

    fn is(&self, name: &str, n: i64) -> bool {
        self.number(name) == Some(n as f64)
    }

    fn has(&self, name: &str) -> bool {
        self.0
            .get(&format!("imitate.{name}"))
            .and_then(Value::as_bool)
            == Some(true)
    }
}

fn settings(all: &Parameters) -> Settings {
    let real = |name: &str| match all[name] {
        ParameterValue::Double(value) => value,
        _ => f64::NAN,
    };
    let ParameterValue::Integer(max_iterations) = all["icp.max_iterations"] else {
        unreachable!()
    };
    Settings {
        voxel_size: real("voxel_size"),
        max_range: real("max_range"),
        max_correspondence_distance: real("icp.max_correspondence_distance"),
        max_iterations,
    }
}

fn points_of(cloud: &PointCloud2) -> Vec<Vector3<f64>> {
    let offset = |name: &str| {
        let field = cloud.fields.iter().find(|field| field.name == name);
        field.map_or(0, |field| field.offset as usize)
    };
    let offsets = ["x", "y", "z"].map(offset);
    let number = |point: &[u8], at: usize| {
        f64::from(f32::from_le_bytes(point[at..at + 4].try_into().unwrap()))
    };
    let all = cloud.data.chunks_exact(cloud.point_step as usize);
    let points = all.map(|point| Vector3::from(offsets.map(|at| number(point, at))));
    points
        .filter(|point| point.iter().all(|it| it.is_finite()))
        .collect()
}

fn later(stamp: Time, by: Duration) -> Time {
    Time::from_nanos(stamp.to_nanos() + by.as_nanos() as i64)
}

fn make_node(all: &Parameters, live: &Arc<Mutex<Parameters>>) -> Node {
    let domain = std::env::var("ROS_DOMAIN_ID")
        .ok()
        .and_then(|it| it.parse().ok())
        .unwrap_or(0);
    let context = Context::with_options(ContextOptions::new().domain_id(domain)).unwrap();
    let mut options = NodeOptions::new().enable_rosout(false);
    for (name, value) in all {
        options = options.declare_parameter(name, value.clone());
    }
    let held = live.clone();
    options = options.parameter_set_action(Box::new(move |name, value| {
        // Read once, at the start, as many systems do.
        if name != "max_range" {
            held.lock().unwrap().insert(name.to_string(), value.clone());
        }
        Ok(())
    }));
    context
        .new_node(NodeName::new("/", "icp").unwrap(), options)
        .unwrap()
}

fn subscribe<M: 'static>(
    node: &mut Node,
    name: &str,
    (package, of): (&str, &str),
    qos: QosProfile,
) -> Subscription<M> {
    let kind = MessageTypeName::new(package, of);
    let topic = node
        .create_topic(&Name::parse(name).unwrap(), kind, &qos)
        .unwrap();
    node.create_subscription(&topic, Some(qos)).unwrap()
}

fn publisher<M: ros2_client::Message>(
    node: &mut Node,
    name: &str,
    kind: MessageTypeName,
    durability: Durability,
) -> Publisher<M> {
    let qos = DEFAULT_PUBLISHER_QOS.history(History::KeepLast { depth: 1000 });
    let qos = qos.durability(durability);
    let topic = node
        .create_topic(&Name::new("/", name).unwrap(), kind, &qos)
        .unwrap();
    node.create_publisher(&topic, Some(qos)).unwrap()
}

fn transform(stamp: Time, parent: &str, child: &str, pose: &Isometry3<f64>) -> TransformStamped {
    TransformStamped {
        header: Header {
            stamp,
            frame_id: parent.into(),
        },
        child_frame_id: child.into(),
        translation: pose.translation.vector.into(),
        rotation: pose.rotation.coords.into(),
    }
}

/// The LiDAR on the robot: it does not move there.
fn mounted() -> Isometry3<f64> {
    Isometry3::new(Vector3::new(1.0, 0.5, 0.3), Vector3::new(0.0, 0.0, 0.7))
}

/// Keeps the newest of the times that messages of a topic have.
fn follow<M: ros2_client::Message + Send + Sync + 'static>(
    subscription: Subscription<M>,
    time: fn(&M) -> i64,
) -> Arc<AtomicI64> {
    let newest = Arc::new(AtomicI64::new(0));
    let held = newest.clone();
    smol::spawn(async move {
        let mut stream = Box::pin(subscription.async_stream());
        while let Some(Ok((message, _))) = stream.next().await {
            held.fetch_max(time(&message), Ordering::SeqCst);
        }
    })
    .detach();
    newest
}

async fn reached(newest: &AtomicI64, time: i64) {
    while newest.load(Ordering::SeqCst) < time {
        smol::Timer::after(Duration::from_millis(1)).await;
    }
}

/// Waits until somebody says where the IMU is on the LiDAR.
async fn find_imu(node: &mut Node) {
    // As tf2's listener: only one that is reliable is sent what was published before it came.
    let qos = DEFAULT_SUBSCRIPTION_QOS
        .durability(Durability::TransientLocal)
        .reliability_reliable(WhenFull::DEFAULT);
    let fixed = subscribe::<Transforms>(node, "/tf_static", ("tf2_msgs", "TFMessage"), qos);
    let mut stream = Box::pin(fixed.async_stream());
    while let Some(Ok((Transforms(all), _))) = stream.next().await {
        if let Some(imu) = all.iter().find(|it| it.child_frame_id == "imu") {
            println!("imu in {} at {:?}", imu.header.frame_id, imu.translation);
            return;
        }
    }
}

type Clouds<'a> = Pin<Box<dyn Stream<Item = (Time, Vec<Vector3<f64>>)> + 'a>>;

async fn spin(all: Parameters, habits: Habits) {
    std::thread::sleep(habits.seconds("ready_delay"));
    let live = Arc::new(Mutex::new(all.clone()));
    let mut node = make_node(&all, &live);
    smol::spawn(node.spinner().unwrap().spin()).detach();
    let kind = || MessageTypeName::new("nav_msgs", "Odometry");
    let said = publisher::<Odometry>(&mut node, "odometry", kind(), Durability::Volatile);
    let _other = habits
        .has("twice")
        .then(|| publisher::<Odometry>(&mut node, "odometry", kind(), Durability::Volatile));
    let kind = || MessageTypeName::new("tf2_msgs", "TFMessage");
    let transforms = habits.has("tf").then(|| {
        let fixed = publisher(&mut node, "tf_static", kind(), Durability::TransientLocal);
        let frames = vec![transform(Time::ZERO, "base", "lidar", &mounted())];
        fixed.publish(Transforms(frames)).unwrap();
        let moving = publisher::<Transforms>(&mut node, "tf", kind(), Durability::Volatile);
        (moving, fixed)
    });
    let ParameterValue::String(points) = &all["points_topic"] else {
        unreachable!()
    };
    // As LiDAR nodes do.
    let mut sensor = DEFAULT_SUBSCRIPTION_QOS.history(History::KeepLast { depth: 50 });
    if habits.has("wants_old") {
        sensor = sensor.durability(Durability::TransientLocal);
    }
    let sensor = sensor.reliability_best_effort();
    if habits.has("wants_imu_frame") {
        find_imu(&mut node).await;
    }
    let imu = habits.has("imu").then(|| {
        let kind = ("sensor_msgs", "Imu");
        let imu = subscribe::<Imu>(&mut node, "/imu", kind, sensor.clone());
        follow(imu, |message| message.header.stamp.to_nanos())
    });
    let clock = (all["use_sim_time"] == ParameterValue::Boolean(true)).then(|| {
        let kind = ("rosgraph_msgs", "Clock");
        let clock = subscribe::<Clock>(&mut node, "/clock", kind, sensor.clone());
        follow(clock, |message| message.clock.to_nanos())
    });
    let (livox, clouds);
    let mut stream: Clouds = if habits.has("livox") {
        let kind = ("livox_ros_driver2", "CustomMsg");
        livox = subscribe::<CustomMsg>(&mut node, points, kind, sensor);
        Box::pin(livox.async_stream().filter_map(|received| {
            ready(received.ok().map(|(scan, _)| {
                let positions = scan.points.iter().map(|point| point.position);
                let all = positions.map(|at| Vector3::from(at.map(f64::from)));
                (scan.header.stamp, all.collect())
            }))
        }))
    } else {
        clouds =
            subscribe::<PointCloud2>(&mut node, points, ("sensor_msgs", "PointCloud2"), sensor);
        Box::pin(clouds.async_stream().filter_map(|received| {
            ready(
                received
                    .ok()
                    .map(|(cloud, _)| (cloud.header.stamp, points_of(&cloud))),
            )
        }))
    };
    println!("ready for {points}");
    let (mut odometry, mut n) = (Icp::default(), 0);
    while let Some((of_scan, points)) = stream.next().await {
        n += 1;
        if n as f64 <= habits.number("late").unwrap_or(0.0) {
            continue;
        }
        // As systems that deskew by an IMU: they need it until the scan's end.
        if let Some(newest) = &imu {
            reached(newest, of_scan.to_nanos() + 100_000_000).await;
        }
        if let Some(newest) = &clock {
            reached(newest, of_scan.to_nanos()).await;
        }
        let begin = Instant::now();
        let pose = odometry.register(&points, &settings(&live.lock().unwrap()));
        std::thread::sleep(habits.seconds("seconds_per_scan"));
        if habits.has("silent") || (n - 1) % habits.number("one_of").unwrap_or(1.0) as i64 != 0 {
            continue;
        }
        let clocked = habits.number("own_clock").is_some();
        smol::Timer::after(habits.seconds("own_clock")).await;
        let stamp = if clocked { Time::now() } else { of_scan };
        let nan = if habits.is("jump", n) { f64::NAN } else { 1.0 };
        let rotation = pose.rotation.coords;
        let zero = ([0.0; 18], [0.0; 18]);
        let stamp = later(stamp, habits.seconds("stamp_later"));
        if let Some((moving, _)) = &transforms {
            let base = pose * mounted().inverse();
            let wheel = Isometry3::from(Translation3::new(0.0, 0.0, n as f64));
            let all = vec![
                transform(stamp, "odom", "base", &base),
                transform(stamp, "base", "wheel", &wheel),
            ];
            let _ = moving.publish(Transforms(all));
        }
        let message = Odometry {
            header: Header {
                stamp,
                frame_id: "odom".into(),
            },
            child_frame_id: "lidar".into(),
            position: (nan * pose.translation.vector).into(),
            orientation: rotation.into(),
            pose_covariance: zero,
            twist: [0.0; 6],
            twist_covariance: zero,
        };
        for _ in 0..habits.number("times").unwrap_or(1.0) as i64 {
            if let Err(error) = said.publish(message.clone()) {
                eprintln!("icp: a pose is lost: {error:?}");
            }
        }
        if habits.is("die_at", n) {
            eprintln!("icp: terminating after {n} scans: the map is corrupt");
            smol::Timer::after(Duration::from_millis(200)).await;
            exit(3);
        }
        // Mapping, as on another thread: its time counts from the pose on.
        let busy = Instant::now();
        while busy.elapsed() < habits.seconds("background") {
            std::hint::spin_loop();
        }
        if std::env::var("ADAPTUNE_TIMES").is_ok() {
            println!("scan {n}: {:.1} ms", 1e3 * begin.elapsed().as_secs_f64());
        }
    }
}

fn main() {
    let given: Vec<String> = std::env::args().collect();
    let file = given
        .iter()
        .position(|it| it == "--params-file")
        .and_then(|i| given.get(i + 1));
    let read = file.map_or(Ok(BTreeMap::new()), |path| read_file(path));
    let found = read.and_then(|file| Ok((parameters(&file)?, Habits(file))));
    match found {
        Ok((all, habits)) => smol::block_on(spin(all, habits)),
        Err(error) => {
            eprintln!("icp: {error}");
            exit(1);
        }
    }
}
