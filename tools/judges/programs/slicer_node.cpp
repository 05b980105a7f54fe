// 3D Slicer without its windows: a scene, and connectors of SlicerOpenIGTLink as client or server.
//
// Commands are lines of standard input, words between tabs: "client NAME PORT", "server NAME PORT", "stop NAME",
// "start NAME", "watch 0|1", "transform NODE 16 NUMBERS", "text NODE TEXT", "status NODE CODE ERROR TEXT",
// "points NODE LABEL X Y Z …", "volume NODE NI NJ NK COMPONENTS VTK_TYPE FILE 16 NUMBERS", "model NODE FILE.vtk",
// "out CONNECTOR NODE", "query CONNECTOR TYPE get|start|stop NAME SECONDS", "command CONNECTOR NAME TEXT", "counts",
// "show NODE".
// States are JSON lines of standard output: connections, nodes that were received, commands, answers.  Lengths are
// millimetres, coordinates RAS.  What Slicer shows in its log is standard error; "counts" has its lines by kind.
// Strategy: the loop of Slicer's timer, every 10 ms; a node is shown after it, once, as a person would see it.

#include <poll.h>
#include <unistd.h>

#include <cmath>
#include <cstdio>
#include <fstream>
#include <map>
#include <set>
#include <sstream>
#include <string>
#include <vector>

#include <igtlioDevice.h>
#include <vtkCellArray.h>
#include <vtkCellData.h>
#include <vtkCommand.h>
#include <vtkIdTypeArray.h>
#include <vtkImageData.h>
#include <vtkMRMLIGTLConnectorNode.h>
#include <vtkMRMLIGTLQueryNode.h>
#include <vtkMRMLIGTLSensorNode.h>
#include <vtkMRMLIGTLStatusNode.h>
#include <vtkMRMLIGTLTrackingDataBundleNode.h>
#include <vtkMRMLIGTLTrackingDataQueryNode.h>
#include <vtkMRMLImageMetaListNode.h>
#include <vtkMRMLLabelMetaListNode.h>
#include <vtkMRMLLinearTransformNode.h>
#include <vtkMRMLMarkupsFiducialNode.h>
#include <vtkMRMLModelNode.h>
#include <vtkMRMLScalarVolumeNode.h>
#include <vtkMRMLScene.h>
#include <vtkMRMLStreamingVolumeNode.h>
#include <vtkMRMLTextNode.h>
#include <vtkMRMLVectorVolumeNode.h>
#include <vtkMatrix4x4.h>
#include <vtkObjectFactory.h>
#include <vtkOutputWindow.h>
#include <vtkPointData.h>
#include <vtkPolyData.h>
#include <vtkPolyDataReader.h>
#include <vtkSlicerOpenIGTLinkCommand.h>

using Words = std::vector<std::string>;

namespace {

// ── what is written ──────────────────────────────────────────────────────────────────────────────────────────────

std::string quoted(const std::string& text) {
  std::string out = "\"";
  char code[8];
  for (unsigned char c : text) {
    if (c == '"' || c == '\\') out += '\\';
    if (c < 0x20) {
      std::snprintf(code, sizeof code, "\\u%04x", c);
      out += code;
    } else
      out += static_cast<char>(c);
  }
  return out + '"';
}
std::string quoted(const char* text) { return quoted(std::string(text ? text : "")); }

std::string number(double value) {
  char text[40];
  std::snprintf(text, sizeof text, std::isfinite(value) ? "%.17g" : "null", value);
  return text;
}

template <typename List, typename Write>
std::string listed(const List& list, Write write) {
  std::string out;
  for (const auto& each : list) out += (out.empty() ? "" : ",") + write(each);
  return "[" + out + "]";
}

std::string listed(vtkMatrix4x4* matrix) { return listed(std::vector<double>(matrix->GetData(), matrix->GetData() + 16), number); }

void say(const std::string& line) {
  std::fputs(("{" + line + "}\n").c_str(), stdout);
  std::fflush(stdout);
}

/// Slicer's log: errors and warnings are counted; "information" is what it writes when a link comes or goes.
class Log : public vtkOutputWindow {
 public:
  static Log* New();
  vtkTypeMacro(Log, vtkOutputWindow);
  void DisplayText(const char* text) override { Write(information, text); }
  void DisplayErrorText(const char* text) override { Write(errors, text); }
  void DisplayWarningText(const char* text) override { Write(warnings, text); }
  void DisplayGenericWarningText(const char* text) override { Write(warnings, text); }
  void DisplayDebugText(const char* text) override { Write(warnings, text); }
  long information = 0, errors = 0, warnings = 0;

 private:
  void Write(long& count, const char* text) {
    ++count;
    if (&count != &information) std::fputs(text, stderr);
  }
};
vtkStandardNewMacro(Log);

std::string folder;
vtkMRMLScene* scene;
std::map<std::string, vtkMRMLIGTLConnectorNode*> connectors;
std::map<std::string, long> counts;                                 // messages by type and name, as the scene saw them
std::set<std::pair<vtkMRMLIGTLConnectorNode*, std::string>> fresh;  // names of nodes that changed in this round
bool watched = true;
long files = 0;

template <typename Value>
std::string stored(const Value* data, size_t size) {
  const std::string path = folder + "/" + std::to_string(++files);
  std::ofstream(path, std::ios::binary).write(reinterpret_cast<const char*>(data), size * sizeof(Value));
  return quoted(path);
}

std::string arrays(vtkDataSetAttributes* attributes, const char* where) {
  std::string out;
  for (int n = 0; n < attributes->GetNumberOfArrays(); ++n) {
    vtkDataArray* array = attributes->GetArray(n);
    std::vector<double> values;
    for (vtkIdType i = 0; i < array->GetNumberOfValues(); ++i)
      values.push_back(array->GetComponent(i / array->GetNumberOfComponents(), i % array->GetNumberOfComponents()));
    out += ",[" + quoted(array->GetName()) + "," + quoted(where) + "," + std::to_string(array->GetNumberOfComponents()) +
           "," + stored(values.data(), values.size()) + "]";
  }
  return out;
}

std::string cells(const char* name, vtkCellArray* array) {
  vtkNew<vtkIdTypeArray> ids;
  array->ExportLegacyFormat(ids);
  return std::string(",\"") + name + "\":" + stored(ids->GetPointer(0), ids->GetNumberOfValues());
}

std::string value(vtkMRMLNode* node) {
  vtkNew<vtkMatrix4x4> matrix;
  if (auto* volume = vtkMRMLVolumeNode::SafeDownCast(node)) {
    volume->GetIJKToRASMatrix(matrix);
    vtkImageData* image = volume->GetImageData();
    const int* size = image->GetDimensions();
    const size_t bytes = image->GetNumberOfPoints() * image->GetNumberOfScalarComponents() * image->GetScalarSize();
    return "\"size\":" + listed(std::vector<int>(size, size + 3), [](int n) { return std::to_string(n); }) +
           ",\"components\":" + std::to_string(image->GetNumberOfScalarComponents()) +
           ",\"scalar\":" + std::to_string(image->GetScalarType()) + ",\"ijk_to_ras\":" + listed(matrix) +
           ",\"voxels\":" + stored(static_cast<char*>(image->GetScalarPointer()), bytes);
  }
  if (auto* transform = vtkMRMLTransformNode::SafeDownCast(node)) {
    transform->GetMatrixTransformToParent(matrix);
    return "\"matrix\":" + listed(matrix);
  }
  if (auto* model = vtkMRMLModelNode::SafeDownCast(node)) {
    vtkPolyData* data = model->GetPolyData();
    std::vector<double> points;
    for (vtkIdType n = 0; n < data->GetNumberOfPoints(); ++n)
      points.insert(points.end(), data->GetPoint(n), data->GetPoint(n) + 3);
    const std::string all = arrays(data->GetPointData(), "point") + arrays(data->GetCellData(), "cell");
    return "\"points\":" + stored(points.data(), points.size()) + cells("vertices", data->GetVerts()) +
           cells("lines", data->GetLines()) + cells("polygons", data->GetPolys()) + cells("strips", data->GetStrips()) +
           ",\"arrays\":[" + (all.empty() ? all : all.substr(1)) + "]";
  }
  if (auto* text = vtkMRMLTextNode::SafeDownCast(node))
    return "\"text\":" + quoted(text->GetText()) + ",\"encoding\":" + std::to_string(text->GetEncoding());
  if (auto* markups = vtkMRMLMarkupsNode::SafeDownCast(node)) {
    std::string out;
    for (int n = 0; n < markups->GetNumberOfControlPoints(); ++n) {
      double place[3];
      markups->GetNthControlPointPositionWorld(n, place);
      out += (n ? ",[" : "[") + quoted(markups->GetNthControlPointLabel(n)) + "," + number(place[0]) + "," +
             number(place[1]) + "," + number(place[2]) + "]";
    }
    return "\"points\":[" + out + "]";
  }
  if (auto* status = vtkMRMLIGTLStatusNode::SafeDownCast(node))
    return "\"code\":" + std::to_string(status->GetCode()) + ",\"subcode\":" + std::to_string(status->GetSubCode()) +
           ",\"error\":" + quoted(status->GetErrorName()) + ",\"text\":" + quoted(status->GetStatusString());
  if (auto* bundle = vtkMRMLIGTLTrackingDataBundleNode::SafeDownCast(node)) {
    std::string out;
    for (int n = 0; n < bundle->GetNumberOfTransformNodes(); ++n) {
      bundle->GetTransformNode(n)->GetMatrixTransformToParent(matrix);
      out += (n ? ",[" : "[") + quoted(bundle->GetTransformNode(n)->GetName()) + "," + listed(matrix) + "]";
    }
    return "\"tools\":[" + out + "]";
  }
  std::string out;
  if (auto* images = vtkMRMLImageMetaListNode::SafeDownCast(node))
    for (int n = 0; n < images->GetNumberOfImageMetaElement(); ++n) {
      vtkMRMLImageMetaElement each;
      images->GetImageMetaElement(n, &each);
      out += (n ? ",[" : "[") + listed(Words{each.Name, each.DeviceName, each.Modality, each.PatientName, each.PatientID},
                                       [](const std::string& text) { return quoted(text); }) +
             "," + number(each.Size[0]) + "," + number(each.Size[1]) + "," + number(each.Size[2]) + "," +
             number(each.ScalarType) + "," + number(each.TimeStamp) + "]";
    }
  if (auto* labels = vtkMRMLLabelMetaListNode::SafeDownCast(node))
    for (int n = 0; n < labels->GetNumberOfLabelMetaElement(); ++n) {
      vtkMRMLLabelMetaListNode::LabelMetaElement each;
      labels->GetLabelMetaElement(n, &each);
      out += (n ? ",[" : "[") + listed(Words{each.Name, each.DeviceName, each.Owner},
                                       [](const std::string& text) { return quoted(text); }) +
             "," + number(each.Label) + "," + number(each.Size[0]) + "," + number(each.Size[1]) + "," +
             number(each.Size[2]) + "]";
    }
  return "\"elements\":[" + out + "]";
}

void show(vtkMRMLNode* node) {
  const std::string attributes = listed(node->GetAttributeNames(), [node](const std::string& name) {
    return "[" + quoted(name) + "," + quoted(node->GetAttribute(name.c_str())) + "]";
  });
  say("\"ev\":\"node\",\"name\":" + quoted(node->GetName()) + ",\"class\":" + quoted(node->GetClassName()) +
      ",\"attributes\":" + attributes + "," + value(node));
}

// ── what happens ─────────────────────────────────────────────────────────────────────────────────────────────────

std::string name_of(vtkMRMLIGTLConnectorNode* connector) { return ",\"connector\":" + quoted(connector->GetName()); }

void happened(vtkObject* caller, unsigned long event, void*, void* data) {
  if (auto* query = vtkMRMLIGTLQueryNode::SafeDownCast(caller)) {
    vtkMRMLNode* node = query->GetResponseDataNode();
    return say("\"ev\":\"answer\",\"status\":" + std::to_string(query->GetQueryStatus()) +
               ",\"node\":" + quoted(node ? node->GetName() : ""));
  }
  auto* connector = static_cast<vtkMRMLIGTLConnectorNode*>(caller);
  if (event == vtkMRMLIGTLConnectorNode::ConnectedEvent) return say("\"ev\":\"connected\"" + name_of(connector));
  if (event == vtkMRMLIGTLConnectorNode::DisconnectedEvent) return say("\"ev\":\"disconnected\"" + name_of(connector));
  if (event == vtkMRMLIGTLConnectorNode::DeviceModifiedEvent) {
    auto* device = static_cast<igtlioDevice*>(data);
    if (!device || !device->MessageDirectionIsIn()) return;
    ++counts[device->GetDeviceType() + " " + device->GetDeviceName()];
    fresh.insert({connector, device->GetDeviceName().empty() ? "OpenIGTLink" : device->GetDeviceName()});
    return;
  }
  auto* command = static_cast<vtkSlicerOpenIGTLinkCommand*>(data);
  const bool received = event == vtkMRMLIGTLConnectorNode::CommandReceivedEvent;
  say(std::string("\"ev\":\"") + (received ? "command" : "response") + "\",\"name\":" + quoted(command->GetName()) +
      ",\"content\":" + quoted(received ? command->GetCommandContent() : command->GetResponseContent()) +
      ",\"status\":" + std::to_string(command->GetCommandStatus()));
  if (!received) return;
  command->SetResponseContent("reply to " + command->GetName() + ": " + command->GetCommandContent());
  command->SetResponseMetaDataElement("Status", "SUCCESS");
  connector->SendCommandResponse(command);
}

void round() {
  for (auto& each : connectors) each.second->PeriodicProcess();
  for (const auto& [connector, name] : fresh)
    for (unsigned n = 0; watched && n < connector->GetNumberOfIncomingMRMLNodes(); ++n) {
      vtkMRMLNode* node = connector->GetIncomingMRMLNode(n);
      const char* original = node ? node->GetAttribute("OriginalNodeName") : nullptr;
      if (original && name == original) show(node);
    }
  fresh.clear();
}

// ── commands ─────────────────────────────────────────────────────────────────────────────────────────────────────

vtkMRMLIGTLConnectorNode* connector_of(const std::string& name) {
  auto*& connector = connectors[name];
  if (connector) return connector;
  connector = vtkMRMLIGTLConnectorNode::SafeDownCast(scene->AddNewNodeByClass("vtkMRMLIGTLConnectorNode", name));
  vtkNew<vtkCallbackCommand> callback;
  callback->SetCallback(happened);
  for (auto event : {connector->ConnectedEvent, connector->DisconnectedEvent, connector->DeviceModifiedEvent,
                     connector->CommandReceivedEvent, connector->CommandCompletedEvent})
    connector->AddObserver(event, callback);
  return connector;
}

template <typename Node>
Node* node_of(const Words& words) {
  vtkMRMLNode* node = scene->GetFirstNodeByName(words[1].c_str());
  return Node::SafeDownCast(node ? node : scene->AddNewNodeByClass(vtkNew<Node>()->GetClassName(), words[1]));
}

void fill(vtkMatrix4x4* matrix, const Words& words, size_t first) {
  for (size_t n = 0; n < 16; ++n) matrix->SetElement(n / 4, n % 4, std::stod(words.at(first + n)));
}

void fill_volume(const Words& words) {
  vtkNew<vtkImageData> image;
  image->SetDimensions(std::stoi(words[2]), std::stoi(words[3]), std::stoi(words[4]));
  image->AllocateScalars(std::stoi(words[6]), std::stoi(words[5]));
  const size_t bytes = image->GetNumberOfPoints() * image->GetNumberOfScalarComponents() * image->GetScalarSize();
  std::ifstream(words[7], std::ios::binary).read(static_cast<char*>(image->GetScalarPointer()), bytes);
  vtkNew<vtkMatrix4x4> matrix;
  fill(matrix, words, 8);
  vtkMRMLVolumeNode* node = image->GetNumberOfScalarComponents() > 1
                                ? static_cast<vtkMRMLVolumeNode*>(node_of<vtkMRMLVectorVolumeNode>(words))
                                : node_of<vtkMRMLScalarVolumeNode>(words);
  node->SetIJKToRASMatrix(matrix);
  node->SetAndObserveImageData(image);
}

void fill_points(const Words& words) {
  auto* node = node_of<vtkMRMLMarkupsFiducialNode>(words);
  MRMLNodeModifyBlocker one_event(node);
  if (!node->GetDisplayNode()) node->CreateDefaultDisplayNodes();
  node->RemoveAllControlPoints();
  for (size_t n = 2; n + 3 < words.size(); n += 4)
    node->AddControlPoint(vtkVector3d(std::stod(words[n + 1]), std::stod(words[n + 2]), std::stod(words[n + 3])), words[n]);
}

void ask(const Words& words) {
  vtkNew<vtkMRMLIGTLQueryNode> query;
  scene->AddNode(query);
  query->SetIGTLName(words[2].c_str());
  query->SetIGTLDeviceName(words[4].c_str());
  query->SetTimeOut(std::stod(words[5]));
  query->SetQueryType(words[3] == "get"     ? vtkMRMLIGTLQueryNode::TYPE_GET
                      : words[3] == "start" ? vtkMRMLIGTLQueryNode::TYPE_START
                                            : vtkMRMLIGTLQueryNode::TYPE_STOP);
  vtkNew<vtkCallbackCommand> callback;
  callback->SetCallback(happened);
  query->AddObserver(vtkMRMLIGTLQueryNode::ResponseEvent, callback);
  connector_of(words[1])->PushQuery(query);
}

void counted(Log* log) {
  const std::string all = listed(counts, [](const std::pair<const std::string, long>& each) {
    return "[" + quoted(each.first) + "," + std::to_string(each.second) + "]";
  });
  say("\"ev\":\"counts\",\"messages\":" + all + ",\"nodes\":" + std::to_string(scene->GetNumberOfNodes()) +
      ",\"errors\":" + std::to_string(log->errors) + ",\"warnings\":" + std::to_string(log->warnings) +
      ",\"information\":" + std::to_string(log->information));
}

void run(const Words& words, Log* log) {
  const std::string& what = words[0];
  if (what == "client") connector_of(words[1])->SetTypeClient("127.0.0.1", std::stoi(words[2]));
  if (what == "server") connector_of(words[1])->SetTypeServer(std::stoi(words[2]));
  if (what == "client" || what == "server" || what == "start") connector_of(words[1])->Start();
  if (what == "stop") connector_of(words[1])->Stop();
  if (what == "watch") watched = words[1] == "1";
  if (what == "counts") counted(log);
  if (what == "query") ask(words);
  if (what == "command") connector_of(words[1])->SendCommand(words[2], words[3], false, 10.0);
  if (what == "show") show(scene->GetFirstNodeByName(words[1].c_str()));
  if (what == "volume") fill_volume(words);
  if (what == "points") fill_points(words);
  if (what == "text") node_of<vtkMRMLTextNode>(words)->SetText(words[2]);
  if (what == "status")
    node_of<vtkMRMLIGTLStatusNode>(words)->SetStatus(std::stoi(words[2]), 0, words[3].c_str(), words[4].c_str());
  if (what == "transform") {
    vtkNew<vtkMatrix4x4> matrix;
    fill(matrix, words, 2);
    node_of<vtkMRMLLinearTransformNode>(words)->SetMatrixTransformToParent(matrix);
  }
  if (what == "model") {
    vtkNew<vtkPolyDataReader> reader;
    reader->SetFileName(words[2].c_str());
    reader->Update();
    node_of<vtkMRMLModelNode>(words)->SetAndObservePolyData(reader->GetOutput());
  }
  if (what == "out") {
    vtkMRMLNode* node = scene->GetFirstNodeByName(words[2].c_str());
    connector_of(words[1])->RegisterOutgoingMRMLNode(node);
    connector_of(words[1])->PushNode(node);
  }
}

Words split(const std::string& line) {
  Words words;
  std::istringstream stream(line);
  for (std::string word; std::getline(stream, word, '\t');) words.push_back(word);
  return words;
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 2) return 2;
  folder = arguments[1];
  vtkNew<Log> log;
  vtkOutputWindow::SetInstance(log);
  vtkNew<vtkMRMLScene> own;
  scene = own;
  for (vtkMRMLNode* node : std::initializer_list<vtkMRMLNode*>{
           vtkMRMLIGTLConnectorNode::New(), vtkMRMLImageMetaListNode::New(), vtkMRMLLabelMetaListNode::New(),
           vtkMRMLIGTLTrackingDataQueryNode::New(), vtkMRMLIGTLTrackingDataBundleNode::New(), vtkMRMLIGTLStatusNode::New(),
           vtkMRMLIGTLSensorNode::New()}) {
    scene->RegisterNodeClass(node);
    node->Delete();
  }
  std::string pending;
  char part[1 << 16];
  pollfd input{0, POLLIN, 0};
  while (true) {
    if (poll(&input, 1, 10) > 0) {
      const ssize_t size = read(0, part, sizeof part);
      if (size <= 0) break;
      pending.append(part, size);
    }
    for (size_t end; (end = pending.find('\n')) != std::string::npos; pending.erase(0, end + 1))
      run(split(pending.substr(0, end)), log);
    round();
  }
  for (auto& each : connectors) each.second->Stop();
  return 0;
}
