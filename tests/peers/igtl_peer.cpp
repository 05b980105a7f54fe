// An independent OpenIGTLink peer on Debian's libopenigtlink-dev (1.11: protocol 2, header version 1).
//
//   igtl_peer client HOST PORT
//   igtl_peer server PORT          (0: any free port; one client after the other)
//
// Every message is encoded and decoded by the library; this program only moves values between the
// library's objects and text.  Two threads: one receives and prints, the other reads commands and sends.
//
// Standard output, one JSON object per line:
//   {"event":"listening"|"connected"|"disconnected"|"refused"|"send_failed"|"error", ...}
//   {"type":..., "device_name":..., "timestamp":{"sec","frac"}, "crc_ok":..., "content":{...}, ...}
// A type outside KINDS below, or a header version that 1.11 cannot read, is skipped by its size and
// printed without "content".
//
// Standard input, one command per line, words between blanks; TEXT is the hex of its bytes or "-" if empty.
// A message is "type device sec frac" (device is TEXT) and its content:
//   TRANSFORM  12 floats: the upper three rows of the matrix, row by row
//   POSITION   x y z ox oy oz w    (only the 28-byte form: encoding the short ones in 1.11 writes beyond
//                                   the buffer it allocated)
//   STRING     encoding TEXT
//   STATUS     code subcode TEXT(error name) TEXT(message)
//   POINT      n  { TEXT(name) TEXT(group) r g b a x y z diameter TEXT(owner) } * n
//   TRAJ       n  { TEXT(name) TEXT(group) type r g b a  entry x y z  target x y z  diameter TEXT(owner) } * n
//   TDATA      n  { TEXT(name) type  12 floats as TRANSFORM } * n
//   QTDATA     n  { TEXT(name) type  x y z  ox oy oz w } * n
//   IMGMETA    n  { TEXT(name) TEXT(device) TEXT(modality) TEXT(patient) TEXT(patient id)  sec nanosec
//                   ni nj nk  scalar_type } * n
//   LBMETA     n  { TEXT(name) TEXT(device)  label r g b a  ni nj nk  TEXT(owner) } * n
//   SENSOR     prefix { unit exponent } * 6  n { value } * n
//   NDARRAY    scalar_type dimensions { size } * dimensions  TEXT(values, in this machine's byte order)
//   COLORT     index_type map_type TEXT(table, in this machine's byte order)
//   CAPABILITY n { TEXT(type) } * n
//   POLYDATA   n { x y z } * n,  4 * ( n { k index * k } * n ),
//              n { type components tuples TEXT(name) float * components * tuples } * n
//              (with one point at least: 1.11 sends uninitialised memory otherwise)
//   IMAGE      ni nj nk  si sj sk  scalar_type components endian coordinate
//              oi oj ok  mi mj mk  12 floats (T S N P)  TEXT(pixels)
//              si…sk: spacing; oi…: sub-volume offset; mi…: sub-volume size; T, S, N are multiplied by the
//              spacing when the library packs them
//   BIND       n { type TEXT(name) and its content } * n
//   GET_BIND, STT_BIND              n { type TEXT(name) } * n
//   STT_TDATA, STT_QTDATA           resolution TEXT(coordinate name)
//   RTS_TDATA, RTS_QTDATA, RTS_BIND status
//   GET_… and STP_… of others       (nothing)
// and beside messages: RAW TEXT | CLOSE | QUIT

#include <sys/types.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <list>
#include <map>
#include <memory>
#include <mutex>
#include <new>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include <igtlBindMessage.h>
#include <igtlCapabilityMessage.h>
#include <igtlClientSocket.h>
#include <igtlColorTableMessage.h>
#include <igtlImageMessage.h>
#include <igtlImageMetaMessage.h>
#include <igtlLabelMetaMessage.h>
#include <igtlMessageHeader.h>
#include <igtlNDArrayMessage.h>
#include <igtlPointMessage.h>
#include <igtlPolyDataMessage.h>
#include <igtlPositionMessage.h>
#include <igtlQuaternionTrackingDataMessage.h>
#include <igtlSensorMessage.h>
#include <igtlServerSocket.h>
#include <igtlStatusMessage.h>
#include <igtlStringMessage.h>
#include <igtlTrackingDataMessage.h>
#include <igtlTrajectoryMessage.h>
#include <igtlTransformMessage.h>
#include <igtl_image.h>
#include <igtl_unit.h>
#include <igtl_util.h>

// The library sends bytes that it never wrote (the reserved ones of TDATA, say).  All memory that it packs
// messages in comes from here, so that they are junk in every run, and the same junk.
const int JUNK = 0xA5;

void* operator new[](std::size_t size) {
  void* memory = std::malloc(size ? size : 1);
  if (!memory) throw std::bad_alloc();
  return std::memset(memory, JUNK, size);
}
void operator delete[](void* memory) noexcept { std::free(memory); }
void operator delete[](void* memory, std::size_t) noexcept { std::free(memory); }

namespace {

const size_t HEADER_SIZE = 58;
const uint64_t BODY_LIMIT = 1u << 30;  // the library keeps sizes in int
const size_t LISTED_VALUES = 256;      // more pixels than this are printed as count and CRC, and as hex

// ---------------------------------------------------------------------------------------- printing

std::mutex output_mutex;

void print_line(const std::string& line) {
  std::lock_guard<std::mutex> lock(output_mutex);
  std::fwrite(line.data(), 1, line.size(), stdout);
  std::fputc('\n', stdout);
  std::fflush(stdout);
}

// JSON text of a byte string.  Bytes above 0x7F go out as they are: the reader decides about encodings.
std::string quoted(const std::string& bytes) {
  std::string out = "\"";
  for (unsigned char c : bytes) {
    if (c == '"' || c == '\\') {
      out += '\\';
      out += static_cast<char>(c);
    } else if (c < 0x20 || c == 0x7F) {
      char escape[8];
      std::snprintf(escape, sizeof escape, "\\u%04x", c);
      out += escape;
    } else {
      out += static_cast<char>(c);
    }
  }
  return out + "\"";
}

std::string hex(const void* data, size_t size) {
  static const char digits[] = "0123456789abcdef";
  const unsigned char* bytes = static_cast<const unsigned char*>(data);
  std::string out(2 * size, '0');
  for (size_t i = 0; i < size; ++i) {
    out[2 * i] = digits[bytes[i] >> 4];
    out[2 * i + 1] = digits[bytes[i] & 15];
  }
  return out;
}

// The shortest text that reads back as the same double (a float is widened first, so it is exact too).
std::string number(double value) {
  if (std::isnan(value)) return "NaN";
  if (std::isinf(value)) return value > 0 ? "Infinity" : "-Infinity";
  char digits[40];
  const std::string text(digits, std::to_chars(digits, digits + sizeof digits, value).ptr);
  return text.find_first_of(".e") == std::string::npos ? text + ".0" : text;  // else -0 would read back as an integer
}
std::string number(float value) { return number(static_cast<double>(value)); }
template <class Integer>
std::string number(Integer value) { return std::to_string(value); }

template <class Value>
std::string list(const Value* values, size_t count) {
  std::string out = "[";
  for (size_t i = 0; i < count; ++i) {
    if (i) out += ", ";
    out += number(values[i]);
  }
  return out + "]";
}

std::string joined(const std::vector<std::string>& items) {
  std::string out = "[";
  for (size_t i = 0; i < items.size(); ++i) out += (i ? ", " : "") + items[i];
  return out + "]";
}

std::string rows(igtl::Matrix4x4& matrix) {
  return joined({list(matrix[0], 4), list(matrix[1], 4), list(matrix[2], 4), list(matrix[3], 4)});
}

std::string hex64(uint64_t value) {
  char text[20];
  std::snprintf(text, sizeof text, "%016llx", static_cast<unsigned long long>(value));
  return text;
}

void reverse_each(std::vector<unsigned char>& bytes, size_t width) {
  for (size_t i = 0; i + width <= bytes.size(); i += width) std::reverse(&bytes[i], &bytes[i] + width);
}

// Numbers in this machine's byte order; of many, their count and the CRC of their big-endian bytes.
template <class Scalar>
std::string scalars(const void* data, size_t size) {
  const size_t count = size / sizeof(Scalar);
  if (count <= LISTED_VALUES) {
    std::vector<Scalar> numbers(count);
    if (count) std::memcpy(numbers.data(), data, size);
    return list(numbers.data(), count);
  }
  const unsigned char* begin = static_cast<const unsigned char*>(data);
  std::vector<unsigned char> bytes(begin, begin + size);
  if (__BYTE_ORDER__ != __ORDER_BIG_ENDIAN__) reverse_each(bytes, sizeof(Scalar));
  return "{\"count\": " + number(count) + ", \"crc64\": \"" + hex64(crc64(bytes.data(), bytes.size(), 0)) + "\"}";
}

std::string values(int scalar_type, const void* data, size_t size) {
  switch (scalar_type) {
    case igtl::NDArrayMessage::TYPE_INT8: return scalars<int8_t>(data, size);
    case igtl::NDArrayMessage::TYPE_UINT8: return scalars<uint8_t>(data, size);
    case igtl::NDArrayMessage::TYPE_INT16: return scalars<int16_t>(data, size);
    case igtl::NDArrayMessage::TYPE_UINT16: return scalars<uint16_t>(data, size);
    case igtl::NDArrayMessage::TYPE_INT32: return scalars<int32_t>(data, size);
    case igtl::NDArrayMessage::TYPE_UINT32: return scalars<uint32_t>(data, size);
    case igtl::NDArrayMessage::TYPE_FLOAT32: return scalars<float>(data, size);
    case igtl::NDArrayMessage::TYPE_FLOAT64:
    case igtl::NDArrayMessage::TYPE_COMPLEX: return scalars<double>(data, size);  // real, imaginary, real …
    default: return "null";
  }
}

// ------------------------------------------------------------------------------------------- kinds

class Words {
 public:
  explicit Words(const std::string& line) : line_(line) {}

  std::string word() {
    const size_t begin = line_.find_first_not_of(' ', at_);
    if (begin == std::string::npos) throw std::runtime_error("too few words");
    at_ = std::min(line_.find(' ', begin), line_.size());
    return line_.substr(begin, at_ - begin);
  }

  long long integer() { return std::stoll(word()); }
  float real() { return std::strtof(word().c_str(), nullptr); }  // also reads nan, inf and hexadecimal floats
  std::vector<float> reals(size_t count) {
    std::vector<float> values(count);
    for (float& value : values) value = real();
    return values;
  }

  template <class Integer>
  std::vector<Integer> integers(size_t count) {
    std::vector<Integer> values(count);
    for (Integer& value : values) value = static_cast<Integer>(integer());
    return values;
  }

  std::string text() {
    const std::string digits = word();
    std::string bytes;
    if (digits == "-") return bytes;
    if (digits.size() % 2) throw std::runtime_error("odd number of hexadecimal digits");
    bytes.reserve(digits.size() / 2);
    for (size_t i = 0; i < digits.size(); i += 2) bytes += static_cast<char>(digit(digits[i]) << 4 | digit(digits[i + 1]));
    return bytes;
  }

  // Something that has to live until the message is packed.
  template <class Thing>
  void keep(const Thing& thing) { kept_.push_back(std::make_shared<Thing>(thing)); }

  void end() {
    if (line_.find_first_not_of(' ', at_) != std::string::npos) throw std::runtime_error("too many words");
  }

 private:
  static int digit(char c) {
    if (c >= '0' && c <= '9') return c - '0';
    if (c >= 'a' && c <= 'f') return c - 'a' + 10;
    throw std::runtime_error("not a hexadecimal digit");
  }

  const std::string& line_;
  size_t at_ = 0;
  std::vector<std::shared_ptr<void>> kept_;
};

// A type of message: how its library object is made, filled from a command's words and shown as JSON members.
struct Kind {
  const char* type;
  igtl::MessageBase::Pointer (*make)();
  void (*fill)(igtl::MessageBase*, Words&);
  std::string (*show)(igtl::MessageBase*);  // null: 1.11 cannot read what it writes itself
  bool is_list;                             // a body without a byte is an empty list
};

const Kind* kind_of(const std::string& type);

// Unpacking BIND and NDARRAY, 1.11 looks at locals that it never set: a count left there by an earlier call would
// be taken for an allocation.
__attribute__((noinline)) void clear_stack() {
  char frames[1 << 14];
  std::memset(frames, 0, sizeof frames);
  asm volatile("" : : "r"(frames) : "memory");
}

// --------------------------------------------------------------------------- message → JSON members

std::string content_of(igtl::TransformMessage* message) {
  igtl::Matrix4x4 matrix;
  message->GetMatrix(matrix);
  return "\"content\": {\"matrix\": " + rows(matrix) + "}";
}

std::string content_of(igtl::PositionMessage* message) {
  static const std::map<int, std::string> packs = {
      {igtl::PositionMessage::POSITION_ONLY, "position_only"},
      {igtl::PositionMessage::WITH_QUATERNION3, "quaternion3"},
      {igtl::PositionMessage::ALL, "all"}};
  float position[3], quaternion[4];
  message->GetPosition(position);
  message->GetQuaternion(quaternion);
  return "\"content\": {\"pack\": " + quoted(packs.at(message->GetPackType())) +
         ", \"position\": " + list(position, 3) + ", \"quaternion\": " + list(quaternion, 4) + "}";
}

std::string content_of(igtl::StringMessage* message) {
  const std::string text = message->GetString();
  return "\"content\": {\"encoding\": " + number(message->GetEncoding()) + ", \"string\": " + quoted(text) +
         ", \"string_hex\": \"" + hex(text.data(), text.size()) + "\"}";
}

std::string content_of(igtl::StatusMessage* message) {
  const char* body = static_cast<const char*>(message->GetPackBodyPointer());
  const int size = message->GetPackBodySize();
  return "\"content\": {\"code\": " + number(message->GetCode()) +
         ", \"subcode\": " + number(message->GetSubCode()) +
         ", \"error_name\": " + quoted(message->GetErrorName()) +
         ", \"status_string\": " + quoted(message->GetStatusString()) +
         ", \"nul_terminated\": " + (size > 30 && body[size - 1] == 0 ? "true" : "false") + "}";
}

std::string content_of(igtl::PointMessage* message) {
  std::vector<std::string> elements;
  for (int i = 0; i < message->GetNumberOfPointElement(); ++i) {
    igtl::PointElement::Pointer element;
    message->GetPointElement(i, element);
    igtlUint8 rgba[4];
    igtlFloat32 position[3];
    element->GetRGBA(rgba);
    element->GetPosition(position);
    elements.push_back("{\"name\": " + quoted(element->GetName()) + ", \"group\": " + quoted(element->GetGroupName()) +
                       ", \"rgba\": " + list(rgba, 4) + ", \"position\": " + list(position, 3) +
                       ", \"diameter\": " + number(element->GetRadius()) +  // the library's name for the field
                       ", \"owner\": " + quoted(element->GetOwner()) + "}");
  }
  return "\"content\": {\"elements\": " + joined(elements) + "}";
}

std::string cells_of(igtl::PolyDataCellArray* cells) {
  std::vector<std::string> items;
  for (igtlUint32 i = 0; cells && i < cells->GetNumberOfCells(); ++i) {
    std::vector<igtlUint32> cell(cells->GetCellSize(i));
    cells->GetCell(i, cell.data());
    items.push_back(list(cell.data(), cell.size()));
  }
  return joined(items);
}

std::string content_of(igtl::PolyDataMessage* message) {
  igtl::PolyDataPointArray* array = message->GetPoints();
  std::vector<std::string> points;
  for (int i = 0; array && i < array->GetNumberOfPoints(); ++i) {
    igtlFloat32 point[3];
    array->GetPoint(i, point);
    points.push_back(list(point, 3));
  }
  std::vector<std::string> attributes;
  for (int i = 0; i < message->GetNumberOfAttributes(); ++i) {
    igtl::PolyDataAttribute* attribute = message->GetAttribute(i);
    std::vector<igtlFloat32> data(attribute->GetSize() * attribute->GetNumberOfComponents());
    attribute->GetData(data.data());
    attributes.push_back("{\"type\": " + number(attribute->GetType()) +
                         ", \"ncomponents\": " + number(attribute->GetNumberOfComponents()) +
                         ", \"n\": " + number(attribute->GetSize()) + ", \"name\": " + quoted(attribute->GetName()) +
                         ", \"data\": " + list(data.data(), data.size()) + "}");
  }
  return "\"content\": {\"points\": " + joined(points) + ", \"num_points\": " + number(points.size()) +
         ", \"vertices\": " + cells_of(message->GetVertices()) + ", \"lines\": " + cells_of(message->GetLines()) +
         ", \"polygons\": " + cells_of(message->GetPolygons()) +
         ", \"triangle_strips\": " + cells_of(message->GetTriangleStrips()) +
         ", \"attributes\": " + joined(attributes) + "}";
}

// The pixels in this machine's byte order, whatever the wire's was (the library does not swap them).
std::vector<unsigned char> pixels_in_host_order(igtl::ImageMessage* message) {
  const int host = __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__ ? igtl::ImageMessage::ENDIAN_BIG : igtl::ImageMessage::ENDIAN_LITTLE;
  const unsigned char* data = static_cast<const unsigned char*>(message->GetScalarPointer());
  std::vector<unsigned char> bytes(data, data + message->GetSubVolumeImageSize());
  if (message->GetEndian() != host) reverse_each(bytes, message->GetScalarSize());
  return bytes;
}

std::string pixels_of(igtl::ImageMessage* message) {
  const std::vector<unsigned char> bytes = pixels_in_host_order(message);
  return values(message->GetScalarType(), bytes.data(), bytes.size());
}

std::string content_of(igtl::ImageMessage* message) {
  int dimensions[3], size[3], offset[3];
  float spacing[3];
  igtl::Matrix4x4 matrix;
  message->GetDimensions(dimensions);
  message->GetSubVolume(size, offset);
  message->GetSpacing(spacing);
  message->GetMatrix(matrix);
  // unpacking converts the image header in place, so the library's own struct has the wire's matrix
  igtl_image_header header;
  std::memcpy(&header, message->GetPackBodyPointer(), sizeof header);
  float wire_matrix[12];
  std::memcpy(wire_matrix, header.matrix, sizeof wire_matrix);

  unsigned char* pixels = static_cast<unsigned char*>(message->GetScalarPointer());
  const size_t bytes = message->GetSubVolumeImageSize();
  return "\"content\": {\"image_version\": " + number(header.version) +
         ", \"num_components\": " + number(message->GetNumComponents()) +
         ", \"scalar_type\": " + number(message->GetScalarType()) + ", \"endian\": " + number(message->GetEndian()) +
         ", \"coordinate\": " + number(message->GetCoordinateSystem()) + ", \"dimensions\": " + list(dimensions, 3) +
         ", \"wire_matrix\": " + list(wire_matrix, 12) + ", \"subvol_offset\": " + list(offset, 3) +
         ", \"subvol_size\": " + list(size, 3) + ", \"data_size\": " + number(bytes) + ", \"data_crc64\": \"" +
         hex64(crc64(pixels, bytes, 0)) +
         "\", \"data\": " + pixels_of(message) +
         ", \"data_hex\": \"" + hex(pixels, bytes) + "\"}, \"lib\": {\"lib_spacing\": " + list(spacing, 3) +
         ", \"lib_matrix\": " + rows(matrix) + "}";
}

std::string content_of(igtl::TrajectoryMessage* message) {
  std::vector<std::string> elements;
  for (int i = 0; i < message->GetNumberOfTrajectoryElement(); ++i) {
    igtl::TrajectoryElement::Pointer element;
    message->GetTrajectoryElement(i, element);
    igtlUint8 rgba[4];
    igtlFloat32 entry[3], target[3];
    element->GetRGBA(rgba);
    element->GetEntryPosition(entry);
    element->GetTargetPosition(target);
    elements.push_back("{\"name\": " + quoted(element->GetName()) + ", \"group\": " + quoted(element->GetGroupName()) +
                       ", \"type\": " + number(element->GetType()) + ", \"rgba\": " + list(rgba, 4) +
                       ", \"entry\": " + list(entry, 3) + ", \"target\": " + list(target, 3) +
                       ", \"diameter\": " + number(element->GetRadius()) + ", \"owner\": " + quoted(element->GetOwner()) + "}");
  }
  return "\"content\": {\"elements\": " + joined(elements) + "}";
}

std::string content_of(igtl::TrackingDataMessage* message) {
  std::vector<std::string> elements;
  for (int i = 0; i < message->GetNumberOfTrackingDataElements(); ++i) {
    igtl::TrackingDataElement::Pointer element;
    message->GetTrackingDataElement(i, element);
    igtl::Matrix4x4 matrix;
    element->GetMatrix(matrix);
    elements.push_back("{\"name\": " + quoted(element->GetName()) + ", \"type\": " + number(element->GetType()) +
                       ", \"matrix\": " + rows(matrix) + "}");
  }
  return "\"content\": {\"elements\": " + joined(elements) + "}";
}

std::string content_of(igtl::QuaternionTrackingDataMessage* message) {
  std::vector<std::string> elements;
  for (int i = 0; i < message->GetNumberOfQuaternionTrackingDataElements(); ++i) {
    igtl::QuaternionTrackingDataElement::Pointer element;
    message->GetQuaternionTrackingDataElement(i, element);
    float position[3], quaternion[4];
    element->GetPosition(position);
    element->GetQuaternion(quaternion);
    elements.push_back("{\"name\": " + quoted(element->GetName()) + ", \"type\": " + number(element->GetType()) +
                       ", \"position\": " + list(position, 3) + ", \"quaternion\": " + list(quaternion, 4) + "}");
  }
  return "\"content\": {\"elements\": " + joined(elements) + "}";
}

std::string content_of(igtl::ImageMetaMessage* message) {
  std::vector<std::string> elements;
  for (int i = 0; i < message->GetNumberOfImageMetaElement(); ++i) {
    igtl::ImageMetaElement::Pointer element;
    message->GetImageMetaElement(i, element);
    igtl::TimeStamp::Pointer time;
    element->GetTimeStamp(time);
    igtlUint32 sec, nanosec;
    time->GetTimeStamp(&sec, &nanosec);
    igtlUint16 size[3];
    element->GetSize(size);
    elements.push_back("{\"name\": " + quoted(element->GetName()) + ", \"device_name\": " + quoted(element->GetDeviceName()) +
                       ", \"modality\": " + quoted(element->GetModality()) +
                       ", \"patient_name\": " + quoted(element->GetPatientName()) +
                       ", \"patient_id\": " + quoted(element->GetPatientID()) +
                       ", \"timestamp\": {\"sec\": " + number(sec) + ", \"nanosec\": " + number(nanosec) +
                       "}, \"size\": " + list(size, 3) + ", \"scalar_type\": " + number(element->GetScalarType()) + "}");
  }
  return "\"content\": {\"elements\": " + joined(elements) + "}";
}

std::string content_of(igtl::LabelMetaMessage* message) {
  std::vector<std::string> elements;
  for (int i = 0; i < message->GetNumberOfLabelMetaElement(); ++i) {
    igtl::LabelMetaElement::Pointer element;
    message->GetLabelMetaElement(i, element);
    igtlUint8 rgba[4];
    igtlUint16 size[3];
    element->GetRGBA(rgba);
    element->GetSize(size);
    elements.push_back("{\"name\": " + quoted(element->GetName()) + ", \"device_name\": " + quoted(element->GetDeviceName()) +
                       ", \"label\": " + number(element->GetLabel()) + ", \"rgba\": " + list(rgba, 4) +
                       ", \"size\": " + list(size, 3) + ", \"owner\": " + quoted(element->GetOwner()) + "}");
  }
  return "\"content\": {\"elements\": " + joined(elements) + "}";
}

std::string content_of(igtl::SensorMessage* message) {
  std::vector<igtlFloat64> values;
  for (unsigned int i = 0; i < message->GetLength(); ++i) values.push_back(message->GetValue(i));
  igtl_unit_data unit;  // of the library's C part: its C++ class has no getters
  igtl_unit_unpack(message->GetUnit(), &unit);
  std::vector<std::string> units;
  for (int i = 0; i < 6; ++i) units.push_back("[" + number(unit.unit[i]) + ", " + number(unit.exp[i]) + "]");
  // no getter for the status either; unpacking leaves the byte where it is
  const igtlUint8 status = static_cast<const igtlUint8*>(message->GetPackBodyPointer())[1];
  return "\"content\": {\"length\": " + number(message->GetLength()) + ", \"status\": " + number(status) +
         ", \"unit\": \"" + hex64(message->GetUnit()) + "\", \"unit_decoded\": {\"prefix\": " + number(unit.prefix) +
         ", \"units\": " + joined(units) + "}, \"values\": " + list(values.data(), values.size()) + "}";
}

std::string content_of(igtl::NDArrayMessage* message) {
  igtl::ArrayBase* array = message->GetArray();
  if (!array) return "\"content\": {\"scalar_type\": " + number(message->GetType()) + "}";  // a type it does not know
  const igtl::ArrayBase::IndexType size = array->GetSize();
  return "\"content\": {\"scalar_type\": " + number(message->GetType()) + ", \"size\": " + list(size.data(), size.size()) +
         ", \"data\": " + values(message->GetType(), array->GetRawArray(), array->GetRawArraySize()) + "}";
}

std::string content_of(igtl::ColorTableMessage* message) {
  const int wide = message->GetMapType() == igtl::ColorTableMessage::MAP_UINT16;
  const int scalar_type = wide ? igtl::NDArrayMessage::TYPE_UINT16 : igtl::NDArrayMessage::TYPE_UINT8;
  return "\"content\": {\"index_type\": " + number(message->GetIndexType()) + ", \"map_type\": " + number(message->GetMapType()) +
         ", \"table\": " + values(scalar_type, message->GetTablePointer(), message->GetColorTableSize()) + "}";
}

std::string content_of(igtl::CapabilityMessage* message) {
  std::vector<std::string> types;
  for (const std::string& type : message->GetTypes()) types.push_back(quoted(type));
  return "\"content\": {\"types\": " + joined(types) + "}";
}

template <class Message>
std::string start_of(Message* message) {
  return "\"content\": {\"resolution\": " + number(message->GetResolution()) +
         ", \"coordinate_name\": " + quoted(message->GetCoordinateName()) + "}";
}
std::string content_of(igtl::StartTrackingDataMessage* message) { return start_of(message); }
std::string content_of(igtl::StartQuaternionTrackingDataMessage* message) { return start_of(message); }

template <class Message>
std::string reply_of(Message* message) { return "\"content\": {\"status\": " + number(message->GetStatus()) + "}"; }
std::string content_of(igtl::RTSTrackingDataMessage* message) { return reply_of(message); }
std::string content_of(igtl::RTSQuaternionTrackingDataMessage* message) { return reply_of(message); }
std::string content_of(igtl::RTSBindMessage* message) { return reply_of(message); }

const char NO_CONTENT[] = "\"content\": {}";
std::string content_of(igtl::MessageBase*) { return NO_CONTENT; }  // GET_… and STP_…

std::string content_of(igtl::BindMessage* message) {
  std::vector<std::string> children;
  for (int i = 0; i < message->GetNumberOfChildMessages(); ++i) {
    const std::string type = message->GetChildMessageType(i);
    const Kind* kind = kind_of(type);
    igtl::MessageBase::Pointer child = kind ? kind->make() : igtl::MessageBase::New();
    message->GetChildMessage(i, child);
    const int size = child->GetBodySizeToRead();
    std::string shown = NO_CONTENT;
    if (!kind || !kind->show) {
      shown = "\"skipped\": true";
    } else if (size > 0) {
      clear_stack();
      child->Unpack();
      shown = kind->show(child);
    } else if (kind->is_list) {
      shown = kind->show(child);
    }
    children.push_back("{\"type\": " + quoted(type) + ", \"name\": " + quoted(child->GetDeviceName()) +
                       ", \"size\": " + number(size) + ", " + shown + "}");
  }
  return "\"content\": {\"children\": " + joined(children) + "}";
}

// --------------------------------------------------------------------------------- words → messages

void accepted(int result, const char* what) {
  if (!result) throw std::runtime_error(std::string("the library refuses this ") + what);
}

void same_size(uint64_t expected, const std::string& bytes, const char* what) {
  if (bytes.size() != expected)
    throw std::runtime_error(std::string(what) + ": expected " + std::to_string(expected) + " bytes, found " + std::to_string(bytes.size()));
}

void read_rows(Words& words, igtl::Matrix4x4& matrix) {
  igtl::IdentityMatrix(matrix);
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 4; ++column) matrix[row][column] = words.real();
}

void fill(igtl::TransformMessage* message, Words& words) {
  igtl::Matrix4x4 matrix;
  read_rows(words, matrix);
  message->SetMatrix(matrix);
}

void fill(igtl::PositionMessage* message, Words& words) {
  message->SetPosition(words.reals(3).data());
  message->SetQuaternion(words.reals(4).data());
  message->SetPackType(igtl::PositionMessage::ALL);
}

void fill(igtl::StringMessage* message, Words& words) {
  message->SetEncoding(static_cast<igtlUint16>(words.integer()));
  std::string text = words.text();
  message->SetString(text);
}

void fill(igtl::StatusMessage* message, Words& words) {
  message->SetCode(static_cast<int>(words.integer()));
  message->SetSubCode(words.integer());
  message->SetErrorName(words.text().c_str());
  message->SetStatusString(words.text().c_str());
}

void fill(igtl::PointMessage* message, Words& words) {
  for (long long left = words.integer(); left > 0; --left) {
    igtl::PointElement::Pointer element = igtl::PointElement::New();
    accepted(element->SetName(words.text().c_str()), "name");
    accepted(element->SetGroupName(words.text().c_str()), "group");
    element->SetRGBA(words.integers<igtlUint8>(4).data());
    element->SetPosition(words.reals(3).data());
    element->SetRadius(words.real());
    accepted(element->SetOwner(words.text().c_str()), "owner");
    message->AddPointElement(element);
  }
}

igtl::PolyDataCellArray::Pointer cells(Words& words) {
  igtl::PolyDataCellArray::Pointer array = igtl::PolyDataCellArray::New();
  for (long long left = words.integer(); left > 0; --left) {
    std::list<igtlUint32> cell;
    for (long long size = words.integer(); size > 0; --size) cell.push_back(static_cast<igtlUint32>(words.integer()));
    array->AddCell(cell);
  }
  return array;
}

void fill(igtl::PolyDataMessage* message, Words& words) {
  igtl::PolyDataPointArray::Pointer points = igtl::PolyDataPointArray::New();
  for (long long left = words.integer(); left > 0; --left) points->AddPoint(words.reals(3).data());
  message->SetPoints(points);
  message->SetVertices(cells(words));
  message->SetLines(cells(words));
  message->SetPolygons(cells(words));
  message->SetTriangleStrips(cells(words));
  for (long long left = words.integer(); left > 0; --left) {
    igtl::PolyDataAttribute::Pointer attribute = igtl::PolyDataAttribute::New();
    const int type = static_cast<int>(words.integer()), components = static_cast<int>(words.integer());
    const size_t tuples = words.integer();
    if (attribute->SetType(type, components) < 0 || attribute->GetNumberOfComponents() != static_cast<igtlUint32>(components))
      throw std::runtime_error("the library refuses attribute type " + number(type) + " with " + number(components) + " components");
    attribute->SetSize(tuples);
    attribute->SetName(words.text().c_str());
    attribute->SetData(words.reals(components * tuples).data());
    message->AddAttribute(attribute);
  }
}

void fill(igtl::ImageMessage* message, Words& words) {
  int dimensions[3], size[3], offset[3];
  for (int& value : dimensions) value = static_cast<int>(words.integer());
  message->SetDimensions(dimensions);
  message->SetSpacing(words.reals(3).data());
  message->SetScalarType(static_cast<int>(words.integer()));
  message->SetNumComponents(static_cast<int>(words.integer()));
  message->SetEndian(static_cast<int>(words.integer()));
  message->SetCoordinateSystem(static_cast<int>(words.integer()));
  for (int& value : offset) value = static_cast<int>(words.integer());
  for (int& value : size) value = static_cast<int>(words.integer());
  if (!message->SetSubVolume(size, offset)) throw std::runtime_error("the library refuses this sub-volume");
  const std::vector<float> columns = words.reals(12);
  igtl::Matrix4x4 matrix = {{0, 0, 0, 0}, {0, 0, 0, 0}, {0, 0, 0, 0}, {0, 0, 0, 1}};
  for (int i = 0; i < 12; ++i) matrix[i % 3][i / 3] = columns[i];
  message->SetMatrix(matrix);
  const std::string pixels = words.text();
  if (pixels.size() != static_cast<size_t>(message->GetSubVolumeImageSize()))
    throw std::runtime_error("the sub-volume has " + std::to_string(message->GetSubVolumeImageSize()) +
                             " bytes of pixels, found " + std::to_string(pixels.size()));
  message->AllocateScalars();
  std::memcpy(message->GetScalarPointer(), pixels.data(), pixels.size());
}

void fill(igtl::TrajectoryMessage* message, Words& words) {
  for (long long left = words.integer(); left > 0; --left) {
    igtl::TrajectoryElement::Pointer element = igtl::TrajectoryElement::New();
    accepted(element->SetName(words.text().c_str()), "name");
    accepted(element->SetGroupName(words.text().c_str()), "group");
    accepted(element->SetType(words.integer()), "type");
    element->SetRGBA(words.integers<igtlUint8>(4).data());
    element->SetEntryPosition(words.reals(3).data());
    element->SetTargetPosition(words.reals(3).data());
    element->SetRadius(words.real());
    accepted(element->SetOwner(words.text().c_str()), "owner");
    message->AddTrajectoryElement(element);
  }
}

void fill(igtl::TrackingDataMessage* message, Words& words) {
  for (long long left = words.integer(); left > 0; --left) {
    igtl::TrackingDataElement::Pointer element = igtl::TrackingDataElement::New();
    accepted(element->SetName(words.text().c_str()), "name");
    accepted(element->SetType(words.integer()), "type");
    igtl::Matrix4x4 matrix;
    read_rows(words, matrix);
    element->SetMatrix(matrix);
    message->AddTrackingDataElement(element);
  }
}

void fill(igtl::QuaternionTrackingDataMessage* message, Words& words) {
  for (long long left = words.integer(); left > 0; --left) {
    igtl::QuaternionTrackingDataElement::Pointer element = igtl::QuaternionTrackingDataElement::New();
    accepted(element->SetName(words.text().c_str()), "name");
    accepted(element->SetType(words.integer()), "type");
    element->SetPosition(words.reals(3).data());
    element->SetQuaternion(words.reals(4).data());
    message->AddQuaternionTrackingDataElement(element);
  }
}

void fill(igtl::ImageMetaMessage* message, Words& words) {
  for (long long left = words.integer(); left > 0; --left) {
    igtl::ImageMetaElement::Pointer element = igtl::ImageMetaElement::New();
    accepted(element->SetName(words.text().c_str()), "name");
    accepted(element->SetDeviceName(words.text().c_str()), "device name");
    accepted(element->SetModality(words.text().c_str()), "modality");
    accepted(element->SetPatientName(words.text().c_str()), "patient name");
    accepted(element->SetPatientID(words.text().c_str()), "patient id");
    igtl::TimeStamp::Pointer time = igtl::TimeStamp::New();
    const igtlUint32 sec = words.integer(), nanosec = words.integer();
    time->SetTime(sec, nanosec);
    element->SetTimeStamp(time);
    element->SetSize(words.integers<igtlUint16>(3).data());
    const int scalar_type = words.integer();
    element->SetScalarType(scalar_type);
    accepted(element->GetScalarType() == scalar_type, "scalar type");
    message->AddImageMetaElement(element);
  }
}

void fill(igtl::LabelMetaMessage* message, Words& words) {
  for (long long left = words.integer(); left > 0; --left) {
    igtl::LabelMetaElement::Pointer element = igtl::LabelMetaElement::New();
    accepted(element->SetName(words.text().c_str()), "name");
    accepted(element->SetDeviceName(words.text().c_str()), "device name");
    element->SetLabel(words.integer());
    element->SetRGBA(words.integers<igtlUint8>(4).data());
    element->SetSize(words.integers<igtlUint16>(3).data());
    accepted(element->SetOwner(words.text().c_str()), "owner");
    message->AddLabelMetaElement(element);
  }
}

void fill(igtl::SensorMessage* message, Words& words) {
  igtl_unit_data unit;
  igtl_unit_init(&unit);
  unit.prefix = words.integer();
  for (int i = 0; i < 6; ++i) {
    unit.unit[i] = words.integer();
    unit.exp[i] = words.integer();
  }
  message->SetUnit(igtl_unit_pack(&unit));
  const unsigned int length = words.integer();
  accepted(message->SetLength(length) == static_cast<int>(length), "length");
  for (unsigned int i = 0; i < length; ++i) message->SetValue(i, std::strtod(words.word().c_str(), nullptr));
}

template <class Scalar>
std::shared_ptr<igtl::ArrayBase> array() { return std::make_shared<igtl::Array<Scalar>>(); }

std::shared_ptr<igtl::ArrayBase> array_of(int scalar_type) {
  switch (scalar_type) {
    case igtl::NDArrayMessage::TYPE_INT8: return array<igtlInt8>();
    case igtl::NDArrayMessage::TYPE_UINT8: return array<igtlUint8>();
    case igtl::NDArrayMessage::TYPE_INT16: return array<igtlInt16>();
    case igtl::NDArrayMessage::TYPE_UINT16: return array<igtlUint16>();
    case igtl::NDArrayMessage::TYPE_INT32: return array<igtlInt32>();
    case igtl::NDArrayMessage::TYPE_UINT32: return array<igtlUint32>();
    case igtl::NDArrayMessage::TYPE_FLOAT32: return array<igtlFloat32>();
    case igtl::NDArrayMessage::TYPE_FLOAT64: return array<igtlFloat64>();
    case igtl::NDArrayMessage::TYPE_COMPLEX: return array<igtlComplex>();
    default: throw std::runtime_error("the library has no such scalar type");
  }
}

void fill(igtl::NDArrayMessage* message, Words& words) {
  const int scalar_type = words.integer();
  const std::shared_ptr<igtl::ArrayBase> array = array_of(scalar_type);
  words.keep(array);  // the message only points at it
  const size_t dimensions = words.integer();
  array->SetSize(words.integers<igtlUint16>(dimensions));
  std::string bytes = words.text();
  same_size(array->GetRawArraySize(), bytes, "values");
  array->SetArray(&bytes[0]);
  message->SetArray(scalar_type, array.get());
}

void fill(igtl::ColorTableMessage* message, Words& words) {
  message->SetIndexType(words.integer());
  message->SetMapType(words.integer());
  message->AllocateTable();
  const std::string table = words.text();
  same_size(message->GetColorTableSize(), table, "table");
  std::memcpy(message->GetTablePointer(), table.data(), table.size());
}

void fill(igtl::CapabilityMessage* message, Words& words) {
  std::vector<std::string> types;
  for (long long left = words.integer(); left > 0; --left) types.push_back(words.text());
  message->SetTypes(types);
}

template <class Message>
void fill_start(Message* message, Words& words) {
  message->SetResolution(words.integer());
  accepted(message->SetCoordinateName(words.text().c_str()), "coordinate name");
}
void fill(igtl::StartTrackingDataMessage* message, Words& words) { fill_start(message, words); }
void fill(igtl::StartQuaternionTrackingDataMessage* message, Words& words) { fill_start(message, words); }

void fill(igtl::RTSTrackingDataMessage* message, Words& words) { message->SetStatus(words.integer()); }
void fill(igtl::RTSQuaternionTrackingDataMessage* message, Words& words) { message->SetStatus(words.integer()); }
void fill(igtl::RTSBindMessage* message, Words& words) { message->SetStatus(words.integer()); }

void fill(igtl::MessageBase*, Words&) {}  // GET_… and STP_…

igtl::MessageBase::Pointer packed(const Kind& kind, const std::string& device, unsigned int sec, unsigned int frac, Words& words) {
  igtl::MessageBase::Pointer message = kind.make();
  message->SetDeviceName(device.c_str());
  message->SetTimeStamp(sec, frac);
  kind.fill(message, words);
  message->Pack();
  return message;
}

void fill(igtl::BindMessage* message, Words& words) {
  for (long long left = words.integer(); left > 0; --left) {
    const Kind* kind = kind_of(words.word());
    if (!kind) throw std::runtime_error("the library has no such type for a child");
    const std::string name = words.text();
    igtl::MessageBase::Pointer child = packed(*kind, name, 0, 0, words);
    words.keep(child);  // the message only points at its body
    message->AppendChildMessage(child);
  }
}

void fill(igtl::GetBindMessage* message, Words& words) {  // and STT_BIND: its interval never reaches the wire
  const int count = words.integer();
  for (int i = 1; i <= count; ++i) {
    const std::string type = words.word(), name = words.text();
    accepted(message->AppendChildMessage(type.c_str(), name.c_str()) == i, "child");
  }
}

// ------------------------------------------------------------------------------------------- table

template <class Message>
igtl::MessageBase::Pointer make() { return Message::New().GetPointer(); }
template <class Message>
void fill_from(igtl::MessageBase* message, Words& words) { fill(static_cast<Message*>(message), words); }
template <class Message>
std::string shown(igtl::MessageBase* message) { return content_of(static_cast<Message*>(message)); }

template <class Message>
constexpr Kind kind(const char* type) { return {type, make<Message>, fill_from<Message>, shown<Message>, false}; }
template <class Message>
constexpr Kind list_kind(const char* type) { return {type, make<Message>, fill_from<Message>, shown<Message>, true}; }
template <class Message>
constexpr Kind query(const char* type) {
  return {type, make<Message>, fill_from<igtl::MessageBase>, shown<igtl::MessageBase>, false};
}
// 1.11 reads GET_BIND and STT_BIND by the layout of BIND, beyond their end.
template <class Message>
constexpr Kind unreadable(const char* type) { return {type, make<Message>, fill_from<Message>, nullptr, false}; }

const Kind KINDS[] = {
    kind<igtl::TransformMessage>("TRANSFORM"),
    kind<igtl::PositionMessage>("POSITION"),
    kind<igtl::StringMessage>("STRING"),
    kind<igtl::StatusMessage>("STATUS"),
    kind<igtl::PolyDataMessage>("POLYDATA"),
    kind<igtl::ImageMessage>("IMAGE"),
    kind<igtl::SensorMessage>("SENSOR"),
    kind<igtl::NDArrayMessage>("NDARRAY"),
    kind<igtl::ColorTableMessage>("COLORT"),
    kind<igtl::BindMessage>("BIND"),
    list_kind<igtl::PointMessage>("POINT"),
    list_kind<igtl::TrajectoryMessage>("TRAJ"),
    list_kind<igtl::TrackingDataMessage>("TDATA"),
    list_kind<igtl::QuaternionTrackingDataMessage>("QTDATA"),
    list_kind<igtl::ImageMetaMessage>("IMGMETA"),
    list_kind<igtl::LabelMetaMessage>("LBMETA"),
    list_kind<igtl::CapabilityMessage>("CAPABILITY"),
    query<igtl::GetTransformMessage>("GET_TRANS"),
    query<igtl::GetStatusMessage>("GET_STATUS"),
    query<igtl::GetPolyDataMessage>("GET_POLYDATA"),
    query<igtl::GetImageMessage>("GET_IMAGE"),
    query<igtl::GetColorTableMessage>("GET_COLORT"),
    query<igtl::GetPointMessage>("GET_POINT"),
    query<igtl::GetTrajectoryMessage>("GET_TRAJ"),
    query<igtl::GetImageMetaMessage>("GET_IMGMETA"),
    query<igtl::GetLabelMetaMessage>("GET_LBMETA"),
    query<igtl::GetCapabilityMessage>("GET_CAPABIL"),
    query<igtl::StopTrackingDataMessage>("STP_TDATA"),
    query<igtl::StopQuaternionTrackingDataMessage>("STP_QTDATA"),
    query<igtl::StopBindMessage>("STP_BIND"),
    kind<igtl::StartTrackingDataMessage>("STT_TDATA"),
    kind<igtl::StartQuaternionTrackingDataMessage>("STT_QTDATA"),
    kind<igtl::RTSTrackingDataMessage>("RTS_TDATA"),
    kind<igtl::RTSQuaternionTrackingDataMessage>("RTS_QTDATA"),
    kind<igtl::RTSBindMessage>("RTS_BIND"),
    unreadable<igtl::GetBindMessage>("GET_BIND"),
    unreadable<igtl::StartBindMessage>("STT_BIND")};

const Kind* kind_of(const std::string& type) {
  for (const Kind& kind : KINDS)
    if (type == kind.type) return &kind;
  return nullptr;
}

// ------------------------------------------------------------------------------------- connections

std::mutex link_mutex;                 // guards `current`
igtl::ClientSocket::Pointer current;   // the connection, null without one
std::mutex send_mutex;

igtl::ClientSocket::Pointer link() {
  std::lock_guard<std::mutex> lock(link_mutex);
  return current;
}

void set_link(igtl::ClientSocket::Pointer socket) {
  std::lock_guard<std::mutex> lock(link_mutex);
  current = socket;
}

struct Disconnected {
  size_t received;  // bytes of the part that was being read
};

// The library's "read fully" cannot tell a close in the middle from one before: take what comes instead.
void receive_exactly(igtl::Socket* socket, void* buffer, size_t size) {
  size_t have = 0;
  while (have < size) {
    const int got = socket->Receive(static_cast<char*>(buffer) + have, static_cast<int>(size - have), 0);
    if (got <= 0) throw Disconnected{have};
    have += got;
  }
}

uint64_t big_endian(const unsigned char* bytes, int size) {
  uint64_t value = 0;
  for (int i = 0; i < size; ++i) value = value << 8 | bytes[i];
  return value;
}

std::string field(const unsigned char* bytes, size_t width) {
  const char* text = reinterpret_cast<const char*>(bytes);
  return std::string(text, strnlen(text, width));
}

std::string decode(const Kind& kind, igtl::MessageHeader* header, igtl::Socket* socket, uint64_t body_size, uint64_t crc) {
  igtl::MessageBase::Pointer message = kind.make();
  bool good = crc == 0;
  if (body_size > 0) {  // (else 1.11 allocates what the type has by default, and checks nothing)
    message->SetMessageHeader(header);
    message->AllocatePack();
    receive_exactly(socket, message->GetPackBodyPointer(), message->GetPackBodySize());
    clear_stack();
    good = message->Unpack(1) & igtl::MessageBase::UNPACK_BODY;
  }
  if (!good) return "\"crc_ok\": false";
  return "\"crc_ok\": true, " + (body_size > 0 || kind.is_list ? kind.show(message) : NO_CONTENT);
}

void skip(igtl::Socket* socket, uint64_t size) {
  std::vector<char> scratch(1 << 16);
  while (size > 0) {
    const size_t part = std::min<uint64_t>(size, scratch.size());
    receive_exactly(socket, scratch.data(), part);
    size -= part;
  }
}

void receive_message(igtl::Socket* socket, bool& inside) {
  igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
  header->InitPack();
  inside = false;
  try {
    receive_exactly(socket, header->GetPackPointer(), header->GetPackSize());
  } catch (const Disconnected& end) {
    inside = end.received > 0;
    throw;
  }
  inside = true;
  unsigned char wire[HEADER_SIZE];  // unpacking converts the library's copy in place
  std::memcpy(wire, header->GetPackPointer(), HEADER_SIZE);
  header->Unpack();

  // The fields that 1.11 loses for a version it does not know are read here, so that the stream survives.
  const uint64_t version = big_endian(wire, 2), body_size = big_endian(wire + 42, 8), crc = big_endian(wire + 50, 8);
  if (body_size > BODY_LIMIT) throw std::runtime_error("body size " + std::to_string(body_size) + " is above the limit");
  const bool readable = version == 1;
  const std::string type = readable ? header->GetDeviceType() : field(wire + 2, 12);
  unsigned int sec = big_endian(wire + 34, 4), frac = big_endian(wire + 38, 4);
  if (readable) header->GetTimeStamp(&sec, &frac);
  const std::string device = readable ? header->GetDeviceName() : field(wire + 14, 20);
  std::string line = "{\"header_version\": " + number(version) + ", \"type\": " + quoted(type) +
                     ", \"device_name\": " + quoted(device) + ", \"timestamp\": {\"sec\": " + number(sec) +
                     ", \"frac\": " + number(frac) + "}, \"body_size\": " + number(body_size) +
                     ", \"crc\": \"" + hex64(crc) + "\"";
  const Kind* kind = kind_of(type);
  if (readable && kind && kind->show) {
    line += ", " + decode(*kind, header, socket, body_size, crc);
  } else {
    skip(socket, body_size);
    line += ", \"skipped\": true";
  }
  print_line(line + "}");
}

void converse(igtl::ClientSocket::Pointer socket) {
  set_link(socket);
  print_line("{\"event\": \"connected\"}");
  bool inside = false;
  std::string reason;
  try {
    for (;;) receive_message(socket.GetPointer(), inside);
  } catch (const Disconnected&) {
  } catch (const std::exception& error) {
    reason = error.what();
  }
  set_link(igtl::ClientSocket::Pointer());
  socket->CloseSocket();
  print_line(std::string("{\"event\": \"disconnected\", \"inside_message\": ") + (inside ? "true" : "false") +
             ", \"reason\": " + quoted(reason) + "}");
}

// ---------------------------------------------------------------------------------------- commands

void send_bytes(const void* data, size_t size) {
  igtl::ClientSocket::Pointer socket = link();
  std::lock_guard<std::mutex> lock(send_mutex);
  if (socket.IsNull() || !socket->Send(data, static_cast<int>(size))) print_line("{\"event\": \"send_failed\"}");
}

void send(const Kind& kind, Words& words) {
  const std::string device = words.text();
  const unsigned int sec = words.integer(), frac = words.integer();
  igtl::MessageBase::Pointer message = packed(kind, device, sec, frac, words);
  words.end();
  send_bytes(message->GetPackPointer(), message->GetPackSize());
}

void send_raw(Words& words) {
  const std::string bytes = words.text();
  words.end();
  send_bytes(bytes.data(), bytes.size());
}

// Wakes the receiving thread, which reports the end of the connection.
void close_link(Words& words) {
  words.end();
  igtl::ClientSocket::Pointer socket = link();
  if (socket.IsNotNull()) socket->CloseSocket();
}

void obey_until_quit() {
  std::string line;
  while (std::getline(std::cin, line) && line != "QUIT") {
    std::string name = "?";
    try {
      Words words(line);
      name = words.word();
      if (const Kind* kind = kind_of(name)) send(*kind, words);
      else if (name == "RAW") send_raw(words);
      else if (name == "CLOSE") close_link(words);
      else throw std::runtime_error("no such command");
    } catch (const std::exception& error) {
      print_line("{\"event\": \"error\", \"command\": " + quoted(name) + ", \"reason\": " + quoted(error.what()) + "}");
    }
  }
}

// The receiving thread may be waiting in the library for ever: end without waiting for it.
[[noreturn]] void leave(int code) {
  output_mutex.lock();
  std::fflush(stdout);
  std::_Exit(code);
}

int usage() {
  std::fputs("usage: igtl_peer client HOST PORT | igtl_peer server PORT\n", stderr);
  return 2;
}

}  // namespace

int main(int argc, char** argv) {
  const std::vector<std::string> arguments(argv + 1, argv + argc);
  std::signal(SIGPIPE, SIG_IGN);
  std::ios::sync_with_stdio(false);
  std::cout.rdbuf(std::cerr.rdbuf());  // the library prints there; standard output is for JSON

  if (arguments.size() == 3 && arguments[0] == "client") {
    igtl::ClientSocket::Pointer socket = igtl::ClientSocket::New();
    if (socket->ConnectToServer(arguments[1].c_str(), std::atoi(arguments[2].c_str())) != 0) {
      print_line("{\"event\": \"refused\"}");
      leave(1);
    }
    std::thread(converse, socket).detach();
  } else if (arguments.size() == 2 && arguments[0] == "server") {
    igtl::ServerSocket::Pointer server = igtl::ServerSocket::New();
    if (server->CreateServer(std::atoi(arguments[1].c_str())) != 0) {
      print_line("{\"event\": \"refused\"}");
      leave(1);
    }
    print_line("{\"event\": \"listening\", \"port\": " + number(server->GetServerPort()) + "}");
    std::thread([server] {
      for (;;) {
        igtl::ClientSocket::Pointer socket = server->WaitForConnection(1000);
        if (socket.IsNotNull()) converse(socket);
      }
    }).detach();
  } else {
    return usage();
  }
  obey_until_quit();
  leave(0);
}
