// What the C++ library sends if its user sets nothing, or only what a message cannot be without.
//
//   igtl_defaults
//
// Standard output, one line for each case: its name, a blank, and the hex of the whole message as the library packs
// it.  Built on Debian's libopenigtlink-dev (1.11) by tests/peers/test_defaults.py.  All memory that is packed is JUNK
// before, so a byte that the library does not write is seen.

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <new>
#include <string>
#include <vector>

#include <igtlBindMessage.h>
#include <igtlCapabilityMessage.h>
#include <igtlColorTableMessage.h>
#include <igtlImageMessage.h>
#include <igtlImageMetaMessage.h>
#include <igtlLabelMetaMessage.h>
#include <igtlNDArrayMessage.h>
#include <igtlPointMessage.h>
#include <igtlPolyDataMessage.h>
#include <igtlPositionMessage.h>
#include <igtlQuaternionTrackingDataMessage.h>
#include <igtlSensorMessage.h>
#include <igtlStatusMessage.h>
#include <igtlStringMessage.h>
#include <igtlTrackingDataMessage.h>
#include <igtlTrajectoryMessage.h>
#include <igtlTransformMessage.h>

const int JUNK = 0xA5;

void* operator new[](std::size_t size) {
  void* memory = std::malloc(size ? size : 1);
  if (!memory) throw std::bad_alloc();
  return std::memset(memory, JUNK, size);
}
void operator delete[](void* memory) noexcept { std::free(memory); }
void operator delete[](void* memory, std::size_t) noexcept { std::free(memory); }

namespace {

void send(const char* name, igtl::MessageBase* message) {
  message->SetDeviceName("Default");
  message->Pack();
  const unsigned char* bytes = static_cast<const unsigned char*>(message->GetPackPointer());
  std::printf("%s ", name);
  for (int i = 0; i < message->GetPackSize(); ++i) std::printf("%02x", bytes[i]);
  std::printf("\n");
  std::fflush(stdout);
}

template <class Message>
void plain(const char* name) {
  typename Message::Pointer message = Message::New();
  send(name, message.GetPointer());
}

// A list of one element as its constructor leaves it.
template <class Message, class Element, class Add>
void list(const char* name, Add add) {
  typename Message::Pointer message = Message::New();
  typename Element::Pointer element = Element::New();
  add(message, element);
  send(name, message.GetPointer());
}

template <class Number>
void array(const char* name) {
  igtl::NDArrayMessage::Pointer message = igtl::NDArrayMessage::New();
  static igtl::Array<Number> numbers;
  std::vector<igtlUint16> size(1, 2);
  numbers.SetSize(size);
  Number values[2] = {1, 2};
  numbers.SetArray(values);
  message->SetArray(igtl::NDArrayMessage::TYPE_FLOAT64, &numbers);
  send(name, message.GetPointer());
}

void surface(const char* name, int type, int components, int tuples) {
  igtl::PolyDataMessage::Pointer message = igtl::PolyDataMessage::New();
  igtl::PolyDataPointArray::Pointer points = igtl::PolyDataPointArray::New();
  for (int i = 0; i < 3; ++i) points->AddPoint(i == 1, i == 2, 0);
  message->SetPoints(points);
  igtl::PolyDataCellArray::Pointer polygons = igtl::PolyDataCellArray::New();
  igtlUint32 triangle[3] = {0, 1, 2};
  polygons->AddCell(3, triangle);
  message->SetPolygons(polygons);
  igtl::PolyDataAttribute::Pointer attribute = igtl::PolyDataAttribute::New();
  attribute->SetType(type, components);
  attribute->SetSize(tuples);
  attribute->SetName("a");
  for (int i = 0; i < tuples; ++i) {
    std::vector<igtlFloat32> values(9);
    for (int k = 0; k < 9; ++k) values[k] = 10 * (i + 1) + k;
    attribute->SetNthData(i, values.data());
  }
  message->AddAttribute(attribute);
  send(name, message.GetPointer());
}

}  // namespace

int main() {
  plain<igtl::TransformMessage>("TRANSFORM");
  plain<igtl::PositionMessage>("POSITION");
  plain<igtl::StatusMessage>("STATUS");
  plain<igtl::StringMessage>("STRING");
  plain<igtl::PointMessage>("POINT");
  plain<igtl::TrajectoryMessage>("TRAJ");
  plain<igtl::SensorMessage>("SENSOR");
  plain<igtl::CapabilityMessage>("CAPABILITY");
  plain<igtl::TrackingDataMessage>("TDATA");
  plain<igtl::QuaternionTrackingDataMessage>("QTDATA");
  plain<igtl::ImageMetaMessage>("IMGMETA");
  plain<igtl::LabelMetaMessage>("LBMETA");
  plain<igtl::BindMessage>("BIND");
  plain<igtl::StartTrackingDataMessage>("STT_TDATA");
  plain<igtl::StopTrackingDataMessage>("STP_TDATA");
  plain<igtl::RTSTrackingDataMessage>("RTS_TDATA");
  plain<igtl::StartQuaternionTrackingDataMessage>("STT_QTDATA");
  plain<igtl::StopQuaternionTrackingDataMessage>("STP_QTDATA");
  plain<igtl::RTSQuaternionTrackingDataMessage>("RTS_QTDATA");
  plain<igtl::GetImageMessage>("GET_IMAGE");
  plain<igtl::GetImageMetaMessage>("GET_IMGMETA");
  plain<igtl::GetLabelMetaMessage>("GET_LBMETA");
  plain<igtl::GetPointMessage>("GET_POINT");
  plain<igtl::GetTrajectoryMessage>("GET_TRAJ");
  plain<igtl::GetStatusMessage>("GET_STATUS");
  plain<igtl::GetColorTableMessage>("GET_COLORT");
  plain<igtl::GetBindMessage>("GET_BIND");
  plain<igtl::StartBindMessage>("STT_BIND");
  plain<igtl::StopBindMessage>("STP_BIND");
  plain<igtl::RTSBindMessage>("RTS_BIND");

  // with what they cannot be without
  {
    igtl::ImageMessage::Pointer image = igtl::ImageMessage::New();
    image->SetDimensions(3, 2, 1);
    image->AllocateScalars();
    std::memset(image->GetScalarPointer(), 7, image->GetImageSize());
    send("IMAGE/pixels", image.GetPointer());
    image = igtl::ImageMessage::New();
    image->SetDimensions(3, 2, 1);
    image->SetCoordinateSystem(0);
    image->AllocateScalars();
    std::memset(image->GetScalarPointer(), 7, image->GetImageSize());
    send("IMAGE/coordinate 0", image.GetPointer());
  }
  {
    igtl::ColorTableMessage::Pointer table = igtl::ColorTableMessage::New();
    table->SetIndexTypeToUint8();
    table->SetMapTypeToUint8();
    table->AllocateTable();
    std::memset(table->GetTablePointer(), 7, table->GetColorTableSize());
    send("COLORT/uint8", table.GetPointer());
  }
  {
    igtl::SensorMessage::Pointer sensor = igtl::SensorMessage::New();
    sensor->SetLength(2);
    sensor->SetValue(0, 1);
    sensor->SetValue(1, 2);
    send("SENSOR/values", sensor.GetPointer());
  }
  array<igtlFloat64>("NDARRAY/values");
  list<igtl::PointMessage, igtl::PointElement>("POINT/element", [](auto& m, auto& e) { m->AddPointElement(e); });
  list<igtl::TrajectoryMessage, igtl::TrajectoryElement>(
      "TRAJ/element", [](auto& m, auto& e) { m->AddTrajectoryElement(e); });
  list<igtl::TrajectoryMessage, igtl::TrajectoryElement>("TRAJ/both ends", [](auto& m, auto& e) {
    e->SetName("path");
    e->SetEntryPosition(1, 2, 3);
    e->SetTargetPosition(4, 5, 6);
    e->SetRadius(2);
    m->AddTrajectoryElement(e);
  });
  list<igtl::TrackingDataMessage, igtl::TrackingDataElement>(
      "TDATA/element", [](auto& m, auto& e) { m->AddTrackingDataElement(e); });
  list<igtl::QuaternionTrackingDataMessage, igtl::QuaternionTrackingDataElement>(
      "QTDATA/element", [](auto& m, auto& e) { m->AddQuaternionTrackingDataElement(e); });
  list<igtl::ImageMetaMessage, igtl::ImageMetaElement>(
      "IMGMETA/element", [](auto& m, auto& e) { m->AddImageMetaElement(e); });
  list<igtl::LabelMetaMessage, igtl::LabelMetaElement>(
      "LBMETA/element", [](auto& m, auto& e) { m->AddLabelMetaElement(e); });
  for (int cell = 0; cell < 2; ++cell)
    for (int kind = 0; kind < 5; ++kind) {
      std::string name = "POLYDATA/" + std::to_string(16 * cell + kind);
      surface(name.c_str(), 16 * cell + kind, 1, cell ? 1 : 3);
    }
  return 0;
}
