// A client or a server with OpenIGTLink's C++ library: answers each TRANSFORM with one that is moved by 1 mm.
#include <cstdlib>
#include <cstring>

#include "igtlClientSocket.h"
#include "igtlServerSocket.h"
#include "igtlTransformMessage.h"

int main(int, char **words) {
  igtl::Socket::Pointer link;
  igtl::ServerSocket::Pointer server = igtl::ServerSocket::New();
  if (!std::strcmp(words[1], "server")) {
    if (server->CreateServer(std::atoi(words[2]))) return 1;
    while (link.IsNull()) link = server->WaitForConnection(1000).GetPointer();
  } else {
    igtl::ClientSocket::Pointer client = igtl::ClientSocket::New();
    if (client->ConnectToServer("127.0.0.1", std::atoi(words[2]))) return 1;
    link = client.GetPointer();
  }
  for (;;) {
    igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
    header->InitPack();
    if (link->Receive(header->GetPackPointer(), header->GetPackSize()) != header->GetPackSize()) return 0;
    header->Unpack();
    igtl::TransformMessage::Pointer message = igtl::TransformMessage::New();
    message->SetMessageHeader(header);
    message->AllocatePack();
    if (!link->Receive(message->GetPackBodyPointer(), message->GetPackBodySize())) return 0;
    message->Unpack();
    igtl::Matrix4x4 matrix;
    message->GetMatrix(matrix);
    matrix[0][3] += 1.0f;
    igtl::TransformMessage::Pointer answer = igtl::TransformMessage::New();
    answer->SetDeviceName("Answer");
    igtl::TimeStamp::Pointer now = igtl::TimeStamp::New();
    now->GetTime();
    answer->SetTimeStamp(now);
    answer->SetMatrix(matrix);
    answer->Pack();
    link->Send(answer->GetPackPointer(), answer->GetPackSize());
  }
}
