// A node on Fast DDS, as LiDAR nodes of ROS 2 are by default: it hears /points best effort, and says
// a pose at the origin on /odometry for each cloud that comes. It prints how many have come. Then it
// is busy for a while, as with a map, and reads nothing: what comes waits in the kernel's buffer.
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <unistd.h>
#include <vector>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::IPLocator;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using Locator = eprosima::fastrtps::rtps::Locator_t;
using Bytes = std::vector<unsigned char>;

// A type of which nothing is known but its name: messages are their bytes.
struct Raw : TopicDataType {
    explicit Raw(const char *name) {
        setName(name);
        m_typeSize = 1 << 22;
        m_isGetKeyDefined = false;
    }
    bool serialize(void *data, SerializedPayload_t *payload) override {
        auto &bytes = *static_cast<Bytes *>(data);
        payload->length = bytes.size();
        std::memcpy(payload->data, bytes.data(), bytes.size());
        return true;
    }
    bool deserialize(SerializedPayload_t *payload, void *data) override {
        static_cast<Bytes *>(data)->assign(payload->data, payload->data + payload->length);
        return true;
    }
    std::function<uint32_t()> getSerializedSizeProvider(void *data) override {
        return [data] { return uint32_t(static_cast<Bytes *>(data)->size()); };
    }
    void *createData() override { return new Bytes; }
    void deleteData(void *data) override { delete static_cast<Bytes *>(data); }
    bool getKey(void *, InstanceHandle_t *, bool) override { return false; }
};

// The odometry of a cloud: its header, a frame, a pose at the origin, and nothing else.
Bytes odometry(const Bytes &cloud) {
    uint32_t length;
    std::memcpy(&length, &cloud[12], 4);
    Bytes bytes(cloud.begin(), cloud.begin() + 16 + length);
    auto align = [&](size_t n) { bytes.resize(4 + (bytes.size() - 4 + n - 1) / n * n); };
    align(4);
    const unsigned char frame[] = {2, 0, 0, 0, 'b', 0};
    bytes.insert(bytes.end(), frame, frame + sizeof frame);
    align(8);
    const double w = 1.0;
    bytes.resize(bytes.size() + 8 * (7 + 36 + 6 + 36));
    std::memcpy(&bytes[bytes.size() - 8 * (1 + 36 + 6 + 36)], &w, 8);
    return bytes;
}

struct Heard : DataReaderListener {
    DataWriter *writer;
    int n = 0;
    void on_data_available(DataReader *reader) override {
        Bytes cloud;
        SampleInfo info;
        while (reader->take_next_sample(&cloud, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            std::printf("clouds: %d\n", ++n);
            std::fflush(stdout);
            Bytes said = odometry(cloud);
            writer->write(&said);
            usleep(100000);
        }
    }
};

// Found on this machine alone, as rmw_fastrtps does it where it is told so.
DomainParticipantQos local() {
    DomainParticipantQos qos;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->maxInitialPeersRange = 32;
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    auto &builtin = qos.wire_protocol().builtin;
    builtin.metatrafficUnicastLocatorList.push_back(Locator());
    Locator peer;
    IPLocator::setIPv4(peer, "127.0.0.1");
    builtin.initialPeersList.push_back(peer);
    return qos;
}

int main() {
    const char *domain = std::getenv("ROS_DOMAIN_ID");
    auto *participant = DomainParticipantFactory::get_instance()->create_participant(
        domain ? std::atoi(domain) : 0, local());
    auto topic = [&](const char *name, const char *kind) {
        TypeSupport(new Raw(kind)).register_type(participant);
        return participant->create_topic(name, kind, TOPIC_QOS_DEFAULT);
    };
    Heard heard;
    auto *publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
    heard.writer = publisher->create_datawriter(
        topic("rt/odometry", "nav_msgs::msg::dds_::Odometry_"), DATAWRITER_QOS_DEFAULT);
    auto *subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    DataReaderQos qos = DATAREADER_QOS_DEFAULT; // best effort
    qos.history().depth = 10;
    subscriber->create_datareader(
        topic("rt/points", "sensor_msgs::msg::dds_::PointCloud2_"), qos, &heard);
    while (true) sleep(60);
}
