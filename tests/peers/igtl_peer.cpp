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
// A type outside TYPES below, or a header version that 1.11 cannot read, is skipped by its size and
// printed without "content".
//
// Standard input, one command per line, words between blanks; TEXT is the hex of its bytes or "-" if empty:
//   TRANSFORM device sec frac  12 floats: the upper three rows of the matrix, row by row
//   POSITION  device sec frac  x y z ox oy oz w      (only the 28-byte form: encoding the short ones in
//                                                     1.11 writes beyond the buffer it allocated)
//   STRING    device sec frac  encoding TEXT
//   STATUS    device sec frac  code subcode TEXT(error name) TEXT(message)
//   POINT     device sec frac  n  { TEXT(name) TEXT(group) r g b a x y z diameter TEXT(owner) } * n
//   POLYDATA  device sec frac  n { x y z } * n,  4 * ( n { k index * k } * n ),
//                              n { type components tuples TEXT(name) float * components * tuples } * n
//                              (with one point at least: 1.11 sends uninitialised memory otherwise)
//   IMAGE     device sec frac  ni nj nk  si sj sk  scalar_type components endian coordinate
//                              oi oj ok  mi mj mk  12 floats (T S N P)  TEXT(pixels)
//                              si…sk: spacing; oi…: sub-volume offset; mi…: sub-volume size; T, S, N are
//                              multiplied by the spacing when the library packs them
//   RAW TEXT | CLOSE | QUIT        (device is TEXT too)

#include <sys/types.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <iostream>
#include <list>
#include <map>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include <igtlClientSocket.h>
#include <igtlImageMessage.h>
#include <igtlMessageHeader.h>
#include <igtlPointMessage.h>
#include <igtlPolyDataMessage.h>
#include <igtlPositionMessage.h>
#include <igtlServerSocket.h>
#include <igtlStatusMessage.h>
#include <igtlStringMessage.h>
#include <igtlTransformMessage.h>
#include <igtl_image.h>
#include <igtl_util.h>

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

// --------------------------------------------------------------------------- message → JSON members

std::string content_of(igtl::TransformMessage* message) {
  igtl::Matrix4x4 matrix;
  message->GetMatrix(matrix);
  return "\"content\": {\"matrix\": " + rows(matrix) + "}";
}

std::string content_of(igtl::PositionMessage* message) {
  static const std::map<int, std::string> packs = {
      {igtl::PositionMessage::POSITION_ONLY, "position_only"},
      {igtl::PositionMessage::WITH_QUATERNION3, "with_quaternion3"},
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

// The pixels with their bytes in that order, whatever the wire's order was (the library does not swap them).
std::vector<unsigned char> pixels_as(int endian, igtl::ImageMessage* message) {
  const unsigned char* data = static_cast<const unsigned char*>(message->GetScalarPointer());
  std::vector<unsigned char> bytes(data, data + message->GetSubVolumeImageSize());
  if (message->GetEndian() != endian) {
    const size_t width = message->GetScalarSize();
    for (size_t i = 0; i + width <= bytes.size(); i += width) std::reverse(&bytes[i], &bytes[i] + width);
  }
  return bytes;
}

template <class Scalar>
std::string scalars(const std::vector<unsigned char>& bytes) {
  std::vector<Scalar> values(bytes.size() / sizeof(Scalar));
  std::memcpy(values.data(), bytes.data(), bytes.size());
  return list(values.data(), values.size());
}

std::string pixels_of(igtl::ImageMessage* message) {
  const int host = __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__ ? igtl::ImageMessage::ENDIAN_BIG : igtl::ImageMessage::ENDIAN_LITTLE;
  const std::vector<unsigned char> bytes = pixels_as(host, message);
  switch (message->GetScalarType()) {
    case igtl::ImageMessage::TYPE_INT8: return scalars<int8_t>(bytes);
    case igtl::ImageMessage::TYPE_UINT8: return scalars<uint8_t>(bytes);
    case igtl::ImageMessage::TYPE_INT16: return scalars<int16_t>(bytes);
    case igtl::ImageMessage::TYPE_UINT16: return scalars<uint16_t>(bytes);
    case igtl::ImageMessage::TYPE_INT32: return scalars<int32_t>(bytes);
    case igtl::ImageMessage::TYPE_UINT32: return scalars<uint32_t>(bytes);
    case igtl::ImageMessage::TYPE_FLOAT32: return scalars<float>(bytes);
    case igtl::ImageMessage::TYPE_FLOAT64: return scalars<double>(bytes);
    default: return "null";
  }
}

// What stands for the values of a large image: their number, and the CRC of their big-endian bytes.
std::string pixel_summary(igtl::ImageMessage* message) {
  std::vector<unsigned char> bytes = pixels_as(igtl::ImageMessage::ENDIAN_BIG, message);
  return "{\"count\": " + number(bytes.size() / message->GetScalarSize()) + ", \"crc64\": \"" +
         hex64(crc64(bytes.data(), bytes.size(), 0)) + "\"}";
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
  const size_t count = bytes / message->GetScalarSize();
  return "\"content\": {\"image_version\": " + number(header.version) +
         ", \"num_components\": " + number(message->GetNumComponents()) +
         ", \"scalar_type\": " + number(message->GetScalarType()) + ", \"endian\": " + number(message->GetEndian()) +
         ", \"coordinate\": " + number(message->GetCoordinateSystem()) + ", \"dimensions\": " + list(dimensions, 3) +
         ", \"wire_matrix\": " + list(wire_matrix, 12) + ", \"subvol_offset\": " + list(offset, 3) +
         ", \"subvol_size\": " + list(size, 3) + ", \"data_size\": " + number(bytes) + ", \"data_crc64\": \"" +
         hex64(crc64(pixels, bytes, 0)) +
         "\", \"data\": " + (count <= LISTED_VALUES ? pixels_of(message) : pixel_summary(message)) +
         ", \"data_hex\": \"" + hex(pixels, bytes) + "\"}, \"lib\": {\"lib_spacing\": " + list(spacing, 3) +
         ", \"lib_matrix\": " + rows(matrix) + "}";
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

using Decoder = std::function<std::string(igtl::MessageHeader*, igtl::Socket*)>;

template <class Message>
std::string decode(igtl::MessageHeader* header, igtl::Socket* socket) {
  typename Message::Pointer message = Message::New();
  message->SetMessageHeader(header);
  message->AllocatePack();
  receive_exactly(socket, message->GetPackBodyPointer(), message->GetPackBodySize());
  if (message->GetPackBodySize() == 0) return "\"crc_ok\": true, " + content_of(message.GetPointer());
  const bool good = message->Unpack(1) & igtl::MessageBase::UNPACK_BODY;
  return good ? "\"crc_ok\": true, " + content_of(message.GetPointer()) : std::string("\"crc_ok\": false");
}

const std::map<std::string, Decoder> TYPES = {
    {"TRANSFORM", decode<igtl::TransformMessage>}, {"POSITION", decode<igtl::PositionMessage>},
    {"STRING", decode<igtl::StringMessage>},       {"STATUS", decode<igtl::StatusMessage>},
    {"POINT", decode<igtl::PointMessage>},         {"POLYDATA", decode<igtl::PolyDataMessage>},
    {"IMAGE", decode<igtl::ImageMessage>}};

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
  const uint64_t version = big_endian(wire, 2), body_size = big_endian(wire + 42, 8);
  if (body_size > BODY_LIMIT) throw std::runtime_error("body size " + std::to_string(body_size) + " is above the limit");
  const bool readable = version == 1;
  const std::string type = readable ? header->GetDeviceType() : field(wire + 2, 12);
  unsigned int sec = big_endian(wire + 34, 4), frac = big_endian(wire + 38, 4);
  if (readable) header->GetTimeStamp(&sec, &frac);
  const std::string device = readable ? header->GetDeviceName() : field(wire + 14, 20);
  std::string line = "{\"header_version\": " + number(version) + ", \"type\": " + quoted(type) +
                     ", \"device_name\": " + quoted(device) + ", \"timestamp\": {\"sec\": " + number(sec) +
                     ", \"frac\": " + number(frac) + "}, \"body_size\": " + number(body_size) +
                     ", \"crc\": \"" + hex64(big_endian(wire + 50, 8)) + "\"";
  const auto decoder = TYPES.find(type);
  if (readable && decoder != TYPES.end()) {
    line += ", " + decoder->second(header.GetPointer(), socket);
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

// --------------------------------------------------------------------------------- commands → messages

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

  std::string text() {
    const std::string digits = word();
    std::string bytes;
    if (digits == "-") return bytes;
    if (digits.size() % 2) throw std::runtime_error("odd number of hexadecimal digits");
    bytes.reserve(digits.size() / 2);
    for (size_t i = 0; i < digits.size(); i += 2) bytes += static_cast<char>(digit(digits[i]) << 4 | digit(digits[i + 1]));
    return bytes;
  }

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
};

void fill(igtl::TransformMessage* message, Words& words) {
  igtl::Matrix4x4 matrix = {{0, 0, 0, 0}, {0, 0, 0, 0}, {0, 0, 0, 0}, {0, 0, 0, 1}};
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 4; ++column) matrix[row][column] = words.real();
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
    element->SetName(words.text().c_str());
    element->SetGroupName(words.text().c_str());
    igtlUint8 rgba[4];
    for (igtlUint8& channel : rgba) channel = static_cast<igtlUint8>(words.integer());
    element->SetRGBA(rgba);
    element->SetPosition(words.reals(3).data());
    element->SetRadius(words.real());
    element->SetOwner(words.text().c_str());
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

void send_bytes(const void* data, size_t size) {
  igtl::ClientSocket::Pointer socket = link();
  std::lock_guard<std::mutex> lock(send_mutex);
  if (socket.IsNull() || !socket->Send(data, static_cast<int>(size))) print_line("{\"event\": \"send_failed\"}");
}

template <class Message>
void send(Words& words) {
  typename Message::Pointer message = Message::New();
  message->SetDeviceName(words.text().c_str());
  const unsigned int sec = words.integer(), frac = words.integer();
  message->SetTimeStamp(sec, frac);
  fill(message.GetPointer(), words);
  words.end();
  message->Pack();
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

const std::map<std::string, void (*)(Words&)> COMMANDS = {
    {"TRANSFORM", send<igtl::TransformMessage>}, {"POSITION", send<igtl::PositionMessage>},
    {"STRING", send<igtl::StringMessage>},       {"STATUS", send<igtl::StatusMessage>},
    {"POINT", send<igtl::PointMessage>},         {"POLYDATA", send<igtl::PolyDataMessage>},
    {"IMAGE", send<igtl::ImageMessage>},         {"RAW", send_raw},
    {"CLOSE", close_link}};

void obey_until_quit() {
  std::string line;
  while (std::getline(std::cin, line) && line != "QUIT") {
    std::string name = "?";
    try {
      Words words(line);
      name = words.word();
      const auto command = COMMANDS.find(name);
      if (command == COMMANDS.end()) throw std::runtime_error("no such command");
      command->second(words);
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
