// The OpenIGTLink side of a measurement on the C++ library (Debian's libopenigtlink-dev), for "bench --peers".
//
//   peer HOST PORT LISTEN TIMES ROLE DEVICE KIND A B RATE COUNT SECONDS
//
// ROLE: send or hear.  KIND: transform, string (A bytes), points (A points) or image (A x B pixels, RGB).
// The orders on standard input, the events on standard output and the numbers in the messages are those of
// programs.py; TIMES gets a line "number nanoseconds" for each message that was sent or heard.  Sending is timed
// before the library packs the message, hearing after it has unpacked it and checked the CRC: what a peer's
// program would call its latency.

#include <igtlClientSocket.h>
#include <igtlImageMessage.h>
#include <igtlMessageHeader.h>
#include <igtlPointMessage.h>
#include <igtlServerSocket.h>
#include <igtlStringMessage.h>
#include <igtlTransformMessage.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <time.h>

#include <atomic>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <mutex>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace {

const long long SECOND = 1000000000LL;
const unsigned EPOCH_S = 1000000000;  // seconds of the stamp of message 0
const double KNOCK_S = 0.1;

long long now_ns() {
  timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return time.tv_sec * SECOND + time.tv_nsec;
}

std::mutex output;
void tell(const std::string& line) {
  std::lock_guard<std::mutex> lock(output);
  std::cout << line << std::endl;
}

std::mutex orders;
std::condition_variable ordered;
bool knocking = false, begun = false, ended = false;
std::atomic<long> heard{0};

void obey() {
  std::string line;
  while (std::getline(std::cin, line)) {
    if (line == "count") tell("{\"event\":\"count\",\"messages\":" + std::to_string(heard.load()) + "}");
    std::lock_guard<std::mutex> lock(orders);
    knocking = knocking || line == "knock";
    begun = begun || line == "begin";
    ordered.notify_all();
  }
  std::lock_guard<std::mutex> lock(orders);
  knocking = begun = ended = true;
  ordered.notify_all();
}

struct Content {
  std::string kind;
  int a, b;
};

igtl::MessageBase::Pointer make(const Content& content, const std::string& device) {
  igtl::MessageBase::Pointer made;
  if (content.kind == "transform") {
    igtl::TransformMessage::Pointer message = igtl::TransformMessage::New();
    igtl::Matrix4x4 matrix = {{0.955f, -0.296f, 0, 10}, {0.296f, 0.955f, 0, -20}, {0, 0, 1, 30.5f}, {0, 0, 0, 1}};
    message->SetMatrix(matrix);
    made = message.GetPointer();
  } else if (content.kind == "string") {
    made = igtl::StringMessage::New().GetPointer();
  } else if (content.kind == "points") {
    igtl::PointMessage::Pointer message = igtl::PointMessage::New();
    for (int at = 0; at < content.a; ++at) {
      igtl::PointElement::Pointer element = igtl::PointElement::New();
      element->SetRGBA(255, 255, 255, 255);
      element->SetPosition(30 * std::cos(at / 16.0f), 30 * std::sin(at / 16.0f), at / 20.0f);
      message->AddPointElement(element);
    }
    made = message.GetPointer();
  } else {
    igtl::ImageMessage::Pointer message = igtl::ImageMessage::New();
    message->SetDimensions(content.a, content.b, 1);
    message->SetSpacing(1, 1, 1);
    message->SetScalarTypeToUint8();
    message->SetNumComponents(3);
    message->AllocateScalars();
    unsigned char* pixels = static_cast<unsigned char*>(message->GetScalarPointer());
    for (unsigned at = 0; at < 3u * content.a * content.b; ++at) pixels[at] = at * 2654435761u >> 24;
    made = message.GetPointer();
  }
  made->SetDeviceName(device.c_str());
  return made;
}

void number_it(igtl::MessageBase* message, const Content& content, unsigned number) {
  igtl::TimeStamp::Pointer stamp = igtl::TimeStamp::New();
  stamp->SetTime(EPOCH_S + number, 0);
  message->SetTimeStamp(stamp);
  if (content.kind == "string") {
    char digits[11];
    std::snprintf(digits, sizeof digits, "%010u", number);
    std::string text = digits + std::string(content.a - 10, '.');
    static_cast<igtl::StringMessage*>(message)->SetString(text);
  }
}

std::vector<std::pair<long, long long>> times;

bool send_one(igtl::Socket* socket, igtl::MessageBase* message, const Content& content, unsigned number) {
  const long long at_ns = now_ns();
  number_it(message, content, number);
  message->Pack();
  if (number) times.emplace_back(number, at_ns);
  return socket->Send(message->GetPackPointer(), message->GetPackSize()) != 0;
}

void send_all(igtl::Socket* socket, const Content& content, const std::string& device, double rate, long count,
              double seconds) {
  igtl::MessageBase::Pointer message = make(content, device);
  {
    std::unique_lock<std::mutex> lock(orders);
    ordered.wait(lock, [] { return knocking; });
    while (!begun) {
      lock.unlock();
      send_one(socket, message, content, 0);
      lock.lock();
      ordered.wait_for(lock, std::chrono::duration<double>(KNOCK_S), [] { return begun; });
    }
  }
  const long long begin_ns = now_ns() + SECOND / 20;
  for (long number = 1; count ? number <= count : now_ns() < begin_ns + seconds * SECOND; ++number) {
    if (rate > 0) {
      const long long due_ns = begin_ns + static_cast<long long>((number - 1) * SECOND / rate);
      const timespec due = {due_ns / SECOND, due_ns % SECOND};
      clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, nullptr);
    }
    if (!send_one(socket, message, content, number)) break;
  }
  tell("{\"event\":\"sent\",\"messages\":" + std::to_string(times.size()) + "}");
}

template <class Message>
igtl::MessageBase::Pointer made_for() {
  return Message::New().GetPointer();
}

void hear_all(igtl::Socket* socket, const std::string& device) {
  igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
  bool first = true;
  for (;;) {
    header->InitPack();
    if (socket->Receive(header->GetPackPointer(), header->GetPackSize()) != header->GetPackSize()) return;
    header->Unpack();
    const std::string type = header->GetDeviceType();
    igtl::MessageBase::Pointer message = type == "TRANSFORM" ? made_for<igtl::TransformMessage>()
                                         : type == "STRING"  ? made_for<igtl::StringMessage>()
                                         : type == "POINT"   ? made_for<igtl::PointMessage>()
                                         : type == "IMAGE"   ? made_for<igtl::ImageMessage>()
                                                             : igtl::MessageBase::Pointer();
    if (message.IsNull() || device != header->GetDeviceName()) {
      socket->Skip(header->GetBodySizeToRead(), 0);
      continue;
    }
    message->SetMessageHeader(header);
    message->AllocatePack();
    const int size = message->GetPackBodySize();
    if (socket->Receive(message->GetPackBodyPointer(), size) != size) return;
    if (!(message->Unpack(1) & igtl::MessageHeader::UNPACK_BODY)) {
      std::cerr << "peer: " << type << ": wrong CRC" << std::endl;
      std::exit(1);
    }
    const long long at_ns = now_ns();
    unsigned seconds = 0, fraction = 0;
    header->GetTimeStamp(&seconds, &fraction);
    long number = static_cast<long>(seconds) - EPOCH_S;
    if (type == "STRING") number = std::atol(static_cast<igtl::StringMessage*>(message.GetPointer())->GetString());
    if (number) {
      times.emplace_back(number, at_ns);
      ++heard;
    } else if (first) {
      first = false;
      tell("{\"event\":\"heard\",\"key\":\"" + device + "\"}");
    }
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 13) return 2;
  const std::string host = argv[1], file = argv[4], role = argv[5], device = argv[6];
  const int port = std::atoi(argv[2]), listen = std::atoi(argv[3]);
  const Content content = {argv[7], std::atoi(argv[8]), std::atoi(argv[9])};
  igtl::ServerSocket::Pointer server;
  igtl::Socket::Pointer socket;
  if (listen) {
    server = igtl::ServerSocket::New();
    if (server->CreateServer(port)) return 1;
    tell("{\"event\":\"listening\",\"host\":\"127.0.0.1\",\"port\":" + std::to_string(server->GetServerPort()) + "}");
    socket = server->WaitForConnection(60000).GetPointer();
  } else {
    igtl::ClientSocket::Pointer client = igtl::ClientSocket::New();
    if (client->ConnectToServer(host.c_str(), port)) return 1;
    socket = client.GetPointer();
  }
  if (socket.IsNull()) return 1;
  std::thread(obey).detach();
  tell("{\"event\":\"ready\"}");
  if (role == "send") {
    send_all(socket, content, device, std::atof(argv[10]), std::atol(argv[11]), std::atof(argv[12]));
  } else {
    std::thread(hear_all, socket.GetPointer(), device).detach();
  }
  {
    std::unique_lock<std::mutex> lock(orders);
    ordered.wait(lock, [] { return ended; });
  }
  std::FILE* out = std::fopen(file.c_str(), "w");
  if (!out) return 1;
  for (const auto& [number, at_ns] : times) std::fprintf(out, "%ld %lld\n", number, at_ns);
  std::fclose(out);
  tell("{\"event\":\"written\"}");
  std::_Exit(0);  // the reading thread waits in the socket
}
