// Serves a skill on a TCP port of this machine, one control step per request: another program, such as a simulator, waits
// for each command.
//
//   lockstep skill.safetensors
//
// The program prints its port. A request is an array of doubles: 1 to begin an episode or 0 to go on, the measured pose
// (O,), and the signals that the policy observes, in their order in skill.json. The answer is the command (O,); at the
// beginning it is the command for an action of zero.
#include <arpa/inet.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstdio>
#include <vector>

#include "guiderail/skill.hpp"

static bool transfer(int socket, double* values, std::size_t count, bool is_read) {
  char* bytes = reinterpret_cast<char*>(values);
  for (std::size_t done = 0; done < count * sizeof(double);) {
    const std::size_t left = count * sizeof(double) - done;
    const ssize_t moved = is_read ? recv(socket, bytes + done, left, 0) : send(socket, bytes + done, left, MSG_NOSIGNAL);
    if (moved <= 0) return false;
    done += static_cast<std::size_t>(moved);
  }
  return true;
}

int main(int argc, char** argv) try {
  if (argc != 2) return std::fprintf(stderr, "usage: lockstep skill.safetensors\n"), 2;
  guiderail::Skill skill{guiderail::Data(argv[1])};
  const auto outputs = static_cast<std::size_t>(skill.outputs());
  std::size_t size = 1 + outputs;
  for (const std::string& name : skill.signals()) size += static_cast<std::size_t>(skill.signal_size(name));
  std::vector<double> request(size), answer(outputs);

  const int server = socket(AF_INET, SOCK_STREAM, 0);
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  socklen_t length = sizeof address;
  sockaddr* generic = reinterpret_cast<sockaddr*>(&address);
  if (server < 0 || bind(server, generic, length) || listen(server, 1) || getsockname(server, generic, &length))
    return std::perror("the port cannot be opened"), 1;
  std::printf("%d\n", ntohs(address.sin_port));
  std::fflush(stdout);
  const int client = accept(server, nullptr, nullptr);
  const int no_delay = 1;
  setsockopt(client, IPPROTO_TCP, TCP_NODELAY, &no_delay, sizeof no_delay);
  while (transfer(client, request.data(), size, true)) {
    const double* pose = request.data() + 1;
    const double* signals = pose + outputs;
    for (const std::string& name : skill.signals()) {
      std::copy_n(signals, skill.signal_size(name), skill.signal(name));
      signals += skill.signal_size(name);
    }
    if (request[0] != 0.0) skill.start(pose);
    std::copy_n(request[0] != 0.0 ? skill.desired() : skill.step(pose).pose, outputs, answer.begin());
    if (!transfer(client, answer.data(), outputs, false)) break;
  }
  close(client);
  close(server);
  return 0;
} catch (const std::exception& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 2;
}
