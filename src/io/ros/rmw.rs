//! Names of ROS 2 on Zenoh, as `rmw_zenoh_cpp` forms them (its design document, "Topic and Service name mapping" and
//! "Graph Cache"; distributions Jazzy and later): the keys of topics, the liveliness tokens that make nodes and
//! publishers known, and what is attached to each message.

use twox_hash::XxHash3_128;

use super::RosType;

/// A node: `namespace` with its leading slash, `name` without any.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct RosNode {
    /// `ROS_DOMAIN_ID`.
    pub domain: u8,
    /// Zenoh's session, as Zenoh prints it.
    pub session: String,
    /// Its number in the session.
    pub number: u32,
    /// Namespace, such as `/alpha`.
    pub namespace: String,
    /// Name.
    pub name: String,
}

/// Slashes within one part of a key.
fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

/// A type as DDS names it: `nav_msgs::msg::dds_::Odometry_`.
fn dds_name(kind: RosType) -> String {
    let name = kind.name();
    let (scope, name) = name.rsplit_once('/').unwrap_or(("", name));
    format!("{}::dds_::{name}_", scope.replace('/', "::"))
}

/// The quality of service as tokens have it, fields of rmw_zenoh's default left out: reliable, with the last `depth`
/// messages kept for late subscribers where it is latched.
fn qos(latched: bool, depth: u32) -> String {
    let durability = if latched { "1" } else { "" };
    format!(":{durability}:,{depth}:,:,:,,")
}

/// The key of a topic's messages; `topic` with its leading slash.
pub fn topic_key(domain: u8, topic: &str, kind: RosType) -> String {
    format!("{domain}/{}/{}/{}", topic.trim_matches('/'), dds_name(kind), kind.hash())
}

impl RosNode {
    fn part(&self, entity: u32, kind: &str) -> String {
        let Self { domain, session, number, namespace, name } = self;
        format!("@ros2_lv/{domain}/{session}/{number}/{entity}/{kind}/%/{}/{name}", mangled(namespace))
    }

    /// The liveliness token of the node.
    pub fn token(&self) -> String {
        self.part(self.number, "NN")
    }

    /// The liveliness token of a publisher of the node; `entity` is its number in the session.
    pub fn publisher_token(
        &self,
        entity: u32,
        topic: &str,
        kind: RosType,
        latched: bool,
        depth: u32,
    ) -> String {
        let (at, topic) = (self.part(entity, "MP"), mangled(topic));
        format!("{at}/{topic}/{}/{}/{}", dds_name(kind), kind.hash(), qos(latched, depth))
    }
}

/// The identity of an entity: XXH3 of its token, 128 bits, the low half first, little endian.
pub fn gid(token: &str) -> [u8; 16] {
    XxHash3_128::oneshot(token.as_bytes()).to_le_bytes()
}

/// What is attached to a message, in Zenoh's serialisation: its number (from 1), when it was published (ns of the
/// system's clock), the publisher with its length.
pub fn attachment(number: i64, published_ns: i64, gid: &[u8; 16]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(33);
    bytes.extend(number.to_le_bytes());
    bytes.extend(published_ns.to_le_bytes());
    bytes.push(16);
    bytes.extend(gid);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node() -> RosNode {
        RosNode {
            domain: 2,
            session: "8b20917502ee955ac4476e0266340d5c".into(),
            number: 0,
            namespace: "/".into(),
            name: "talker".into(),
        }
    }

    /// The examples of the design document, with a type of ours.
    #[test]
    fn keys_and_tokens_are_those_of_the_design_document() {
        let node = node();
        assert_eq!(node.token(), "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/0/NN/%/%/talker");
        let hash = RosType::Log.hash();
        assert_eq!(
            node.publisher_token(10, "/chatter", RosType::Log, false, 7),
            format!(
                "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/\
                 rcl_interfaces::msg::dds_::Log_/{hash}/::,7:,:,:,,"
            )
        );
        let within = RosNode { namespace: "/robot1".into(), ..node };
        assert!(within.token().ends_with("/NN/%/%robot1/talker"), "{}", within.token());
        let latched = within.publisher_token(3, "/a/b", RosType::TfMessage, true, 1);
        assert!(latched.contains("/%a%b/tf2_msgs::msg::dds_::TFMessage_/RIHS01_"), "{latched}");
        assert!(latched.ends_with("/:1:,1:,:,:,,"), "{latched}");
        assert_eq!(
            topic_key(0, "/robot1/chatter", RosType::Log),
            format!("0/robot1/chatter/rcl_interfaces::msg::dds_::Log_/{hash}")
        );
    }

    /// Published values of XXH3-128 with no seed: of nothing, and of the test vectors' algorithm for one byte.
    #[test]
    fn an_identity_is_the_hash_of_its_token() {
        assert_eq!(XxHash3_128::oneshot(b""), 0x99aa_06d3_0147_98d8_6001_c324_468d_497f);
        let gid = gid("");
        assert_eq!(gid[..8], 0x6001_c324_468d_497f_u64.to_le_bytes());
        assert_eq!(gid[8..], 0x99aa_06d3_0147_98d8_u64.to_le_bytes());
        let attached = attachment(1, 2, &gid);
        assert_eq!(attached.len(), 33);
        assert_eq!((attached[0], attached[8], attached[16]), (1, 2, 16));
        assert_eq!(attached[17..], gid);
    }
}
